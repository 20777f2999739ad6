"""Log, metrics, delays and the notifications of the service manager."""
