"""Commands of `toolpoint dynamics`."""
