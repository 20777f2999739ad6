"""What many machines of a type teach: a model of the type, and how a sister with few recordings takes it over."""
