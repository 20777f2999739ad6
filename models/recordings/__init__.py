"""A recording as data: its parts, what may be wrong with it, jumps."""
