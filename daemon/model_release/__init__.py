"""Released thermal models: who could change them, what was released by whom, and how one is released."""
