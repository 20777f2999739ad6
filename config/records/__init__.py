"""Records that a person signs for: of a commissioning, and of a released model."""
