"""Reads displacements from the growing files of an A/D logger."""
