"""What identifications of a spindle refuse."""


class IdentificationError(ValueError):
    """Data do not allow an identification; the text says why and what to do."""
