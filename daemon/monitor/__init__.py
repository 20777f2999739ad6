"""The daemon's interface to people and other programs: socket, status, view, metrics."""
