"""Commands for setting up: configuration, guard, commissioning, models, back-ups."""
