"""What the `toolpoint dynamics` commands compute: reading spindle files, results as plain data, pictures."""
