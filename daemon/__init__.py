"""The edge daemon: composition root, pipeline, history, telemetry and command line."""
