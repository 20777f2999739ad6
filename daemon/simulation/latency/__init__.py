"""The delay experiment: a sensor is moved between two packs until the CNC shows it."""
