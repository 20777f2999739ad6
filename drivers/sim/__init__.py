"""The simulated machine: its own physics, in-process devices, wire faces and fault scripts."""
