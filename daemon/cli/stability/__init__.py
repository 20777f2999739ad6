"""Commands of `toolpoint stability`."""
