"""Thermal error from temperatures: fitting, model files, evaluation and the estimate itself."""
