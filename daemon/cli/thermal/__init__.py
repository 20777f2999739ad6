"""Commands of `toolpoint thermal`."""
