"""Checks of the computer (`toolpoint doctor`) and of what the configuration names (`toolpoint check`)."""
