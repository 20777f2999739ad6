"""Quality and reason of one measured value."""

from enum import IntEnum


class Quality(IntEnum):
    """Whether a value may be used."""

    GOOD = 0
    """Measured in this cycle and accepted."""
    HELD = 1
    """Rejected in this cycle; the last accepted value stands, with its age."""
    MISSING = 2
    """No value, and none that may stand for it."""


class Reason(IntEnum):
    """Why a value is not GOOD (NONE when it is)."""

    NONE = 0
    NOT_RECEIVED = 1
    """No frame with this sensor's ID arrived in the cycle."""
    DUPLICATE_ID = 2
    """The ID came twice, or took another's place; both values are dropped."""
    RESET = 3
    """TMP102 reads 0 until its first conversion after a node reset."""
    DEVICE_ERROR = 4
    """The sensor's own error flag (MLX90615 bit 15, or a status byte)."""
    OUT_OF_RANGE = 5
    """Outside the range that the configuration calls possible."""
    RATE = 6
    """Changed by more than the cleansing threshold allows for the elapsed time."""
    QUARANTINED = 7
    """The line was renumbered or its count changed; its values are not assigned to sensors."""
    STALE = 8
    """No accepted value for longer than the configuration allows."""
    OVERFLOW = 9
    """The logger wrote an overflow token."""
    UNREADABLE = 10
    """The field could not be read as a number."""
    UNCONFIRMED = 11
    """A first value, a value after a gap or a change above the noise that further readings have not confirmed yet."""
    ELSEWHERE = 12
    """A displacement channel of another source, which brings rows of its own."""
    OTHER_UNIT = 13
    """All sensors of its input went over to another unit."""


GOOD, ACCEPTED = int(Quality.GOOD), int(Reason.NONE)
"""`Quality.GOOD` and `Reason.NONE` as plain numbers: an array is compared with a member of an enumeration five times as
slowly, which counts on the way to the CNC."""


def describe(reason: Reason | int) -> str:
    """Return the reason in words for a log, the monitor or a report."""
    return _WORDS[Reason(reason)]


_WORDS = {
    Reason.NONE: "accepted",
    Reason.NOT_RECEIVED: "not received",
    Reason.DUPLICATE_ID: "duplicate ID in the cycle",
    Reason.RESET: "node reset (reads 0 before its first conversion)",
    Reason.DEVICE_ERROR: "sensor reports an error",
    Reason.OUT_OF_RANGE: "outside the possible range",
    Reason.RATE: "changed faster than the cleansing threshold",
    Reason.QUARANTINED: "line quarantined (renumbered or changed count)",
    Reason.STALE: "no accepted value for too long",
    Reason.OVERFLOW: "logger overflow",
    Reason.UNREADABLE: "unreadable field",
    Reason.UNCONFIRMED: "not yet confirmed by further readings",
    Reason.ELSEWHERE: "measured by another source",
    Reason.OTHER_UNIT: "its source says another unit than before",
}
