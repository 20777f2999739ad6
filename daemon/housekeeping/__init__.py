"""Jobs that run now and then, each in a process of its own."""
