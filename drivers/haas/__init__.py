"""A Haas control over its machine data collection (MDC)."""
