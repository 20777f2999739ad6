"""Commands for running the daemon and reading what it recorded."""
