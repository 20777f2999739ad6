"""Exceptions: what the models refuse, and the base of all refusals of a person's input."""


class RefusedInputError(Exception):
    """What a person gave cannot be used; the text says why and what to do. A command ends with it."""


class IdentificationError(RefusedInputError, ValueError):
    """Data do not allow an identification; the text says why and what to do."""


class StabilityError(RefusedInputError, ValueError):
    """A case, response or recording that gives no answer; the text says why and what to do."""
