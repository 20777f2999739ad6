"""Bearing properties from temperatures (5-1), and the tool point's frequency response over time."""
