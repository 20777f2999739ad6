"""The monitor in the browser: pages, API, live events and metrics, served by the daemon itself."""
