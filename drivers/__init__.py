"""Everything that touches a wire or a foreign file."""
