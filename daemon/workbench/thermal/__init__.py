"""Training, evaluation and reports of thermal models from recordings on disk."""
