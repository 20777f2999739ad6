"""What the stability library refuses."""


class StabilityError(ValueError):
    """A case, response or recording that gives no answer; the text says why and what to do."""
