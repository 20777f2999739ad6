"""Reads and writes the CNC over OPC UA."""
