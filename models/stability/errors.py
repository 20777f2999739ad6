"""What the stability library refuses."""

from models.errors import RefusedInputError


class StabilityError(RefusedInputError, ValueError):
    """A case, response or recording that gives no answer; the text says why and what to do."""
