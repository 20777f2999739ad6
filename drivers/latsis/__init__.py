"""Reads a LATSIS line: port, frames, cycles, values."""
