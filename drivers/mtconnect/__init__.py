"""Reads a machine from an MTConnect agent, which is never written to."""
