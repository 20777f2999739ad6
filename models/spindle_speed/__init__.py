"""Which spindle speed to take, and when it may change."""
