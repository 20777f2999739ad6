"""What identifications of a spindle refuse."""

from models.errors import RefusedInputError


class IdentificationError(RefusedInputError, ValueError):
    """Data do not allow an identification; the text says why and what to do."""
