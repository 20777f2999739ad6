"""What ends a commissioning, in a sentence."""


class CommissioningRefusedError(Exception):
    """The commissioning cannot begin or go on; the text says what, why, and what the person can do."""


class ForeignWriterError(CommissioningRefusedError):
    """Somebody else writes the block: nothing more may be written, not even a retreat."""
