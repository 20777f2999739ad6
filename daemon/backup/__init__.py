"""Back-ups of one installation: one tar with a manifest, made beside the running daemon, verified before use."""
