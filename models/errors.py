"""What all refusals of a person's input have in common."""


class RefusedInputError(Exception):
    """What a person gave cannot be used; the text says why and what to do. A command ends with it."""
