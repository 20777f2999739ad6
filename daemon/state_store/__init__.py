"""What the daemon keeps for its next start: one typed, versioned document per key of the store."""
