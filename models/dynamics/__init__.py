"""Spindle dynamics: composite sections, exact beam segments, coupling, bearings, modes, identification."""
