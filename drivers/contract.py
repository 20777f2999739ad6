"""What the daemon expects of a driver, and what drivers of a CNC share.

A driver is built new for every attempt, used by one task, and closed fully. It never retries:
it raises `LinkError` (try again later) or `FatalDriverError` (a person must change something);
the supervisor owns retry and counts any other exception as retriable, loudly.
"""

import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from enum import StrEnum, auto
from typing import Literal, Protocol

from config.schema.cnc import AxisPositionConfig, CncConfig
from models.errors import RefusedInputError
from models.records import CncMode, CncRun, CncSample, DisplacementSample, TemperatureCycle

SIMULATED_CNC_IDENTITY = "urn:toolpoint:simulated-cnc"
"""What the simulated machine's control calls itself; nothing else may be driven by a scaled clock."""
Security = Literal["encrypted", "insecure"]
MODES = {0: CncMode.MDI, 1: CncMode.MEMORY, 3: CncMode.EDIT, 4: CncMode.HANDLE, 5: CncMode.JOG, 10: CncMode.REMOTE}
RUNS = {0: CncRun.RESET, 1: CncRun.STOP, 2: CncRun.HOLD, 3: CncRun.START, 4: CncRun.START}
"""FANUC's codes for mode and run, which several protocols carry."""


class Capability(StrEnum):
    """What a control may give and take; a driver says which it cannot, and why."""

    READ_MACROS = auto()
    WRITE_MACROS = auto()
    PROGRAM = auto()
    SEQUENCE_NUMBER = auto()
    SPINDLE_SPEED = auto()
    MOTOR_TEMPERATURE = auto()
    CLOCK = auto()
    POWER_ON_COUNT = auto()
    WORK_OFFSET = auto()
    TOOL_NUMBER = auto()
    AXIS_POSITION = auto()


class DriverError(Exception):
    """Base of the errors that a driver raises on purpose; the text is fit for an operator."""


class LinkError(DriverError):
    """The device cannot be reached or went away; trying again later may help."""


class FatalDriverError(RefusedInputError, DriverError):
    """Trying again cannot help: wrong configuration, refused credentials, unknown device."""


class NotSentError(FatalDriverError):
    """A write was refused before anything was sent: the control holds what it held. Other errors leave that open."""


class TemperatureSource(Protocol):
    """One LATSIS line, or one other source of temperatures."""

    name: str

    def cycles(self) -> AsyncIterator[TemperatureCycle]:
        """Open it and yield each cycle as it completes; raises LinkError when it is lost."""

    async def close(self) -> None:
        """Release the port. May be called in any state, more than once; never raises."""


class DisplacementSource(Protocol):
    """The files of one A/D logger."""

    name: str

    def samples(
        self, on_problem: Callable[[str], None] = ..., on_reached: Callable[[], None] = ...
    ) -> AsyncIterator[DisplacementSample]:
        """Follow the file and yield each new row once, in file order; raises LinkError.

        `on_problem` takes in words what cannot be read; `on_reached` is called when a look at the files has succeeded.
        """

    async def close(self) -> None:
        """Release everything. May be called in any state, more than once; never raises."""


class Cnc(Protocol):
    """One CNC. Every call ends within the configured time-out, by result or by LinkError."""

    identity: str
    """What the control calls itself (known after connect); commissioning is bound to it."""
    security: Security
    """Encrypted: signed, encrypted and with a named user (known before connect)."""

    @property
    def cannot(self) -> Mapping[str, str]:
        """Which `Capability` this control does not have, with the reason (known after connect)."""

    async def connect(self) -> None:
        """Connect; raises LinkError or FatalDriverError."""

    async def read(self, macros: Sequence[int]) -> CncSample:
        """Read the machine's state and the given macro variables in one request."""

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables; None where a variable is vacant."""

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Write groups of (macro, value), each group only after the previous one was accepted.

        Raises LinkError on a lost link, and where the control cannot take a value now; NotSentError where
        `refuse_forbidden` does, before anything is sent; another FatalDriverError (naming the macro) when the control
        refuses a value, after what came before it, and perhaps what came with it, has arrived. Never retries.
        """

    async def close(self) -> None:
        """Close fully. May be called in any state, more than once; never raises."""


def refuse_forbidden(groups: Sequence[Sequence[tuple[int, float]]], config: CncConfig, security: Security) -> None:
    """Refuse, before anything is sent, what no driver may write; raises NotSentError."""
    if security == "insecure" and not config.allow_insecure_writes:
        raise NotSentError(f"nothing is written over an unencrypted, anonymous connection: {config.insecure_advice}")
    for group in groups:
        for number, value in group:
            if number not in config.macros.allowed:
                raise NotSentError(f"macro variable #{number} is outside cnc.macros.writable; nothing was sent")
            if not math.isfinite(value):
                raise NotSentError(f"{value} must not be written to macro variable #{number}; nothing was sent")


MM_PER_INCH = 25.4


def what_broke(error: Exception) -> str:
    """Say what ended a connection, or kept it from coming about."""
    nobody = "nothing listens there: check address and port, and that the server runs"
    return nobody if isinstance(error, ConnectionRefusedError) else str(error) or type(error).__name__


def position_mm(axis: AxisPositionConfig, value: float | None, *, inch: bool | None = None) -> float:
    """Return a machine position [mm], NaN for none; `inch` is what the control says of its unit, None: nothing."""
    if value is None or not math.isfinite(value):
        return math.nan
    return value * MM_PER_INCH if (axis.unit == "inch" if inch is None else inch) else value


class ClockWatch:
    """Notices a control that answers from memory: its clock no longer moves."""

    def __init__(self, name: str, stale_after_s: float) -> None:
        self._name = name
        self._stale_after_s = stale_after_s
        self._value_s = math.nan
        self._moved_s = 0.0

    def stands_still(self, sample: CncSample) -> str:
        """Return why the link counts as lost, '' while the clock moves."""
        now_s = sample.time.monotonic_s
        if sample.clock_s != self._value_s:
            self._value_s, self._moved_s = sample.clock_s, now_s
        elif now_s - self._moved_s > self._stale_after_s:
            return (
                f"{self._name} answers but its clock stands still at {sample.clock_s:g} s "
                f"for {now_s - self._moved_s:.1f} s"
            )
        return ""
