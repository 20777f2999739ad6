"""What people and other programs see of the daemon: socket, status, view, metrics, log."""
