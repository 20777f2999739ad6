"""Commands that run the daemon beside a simulated machine."""
