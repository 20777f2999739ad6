"""Decides whether an axis may be switched on, and whether anything may be written to the CNC at all."""

from collections.abc import Callable, Iterator
from functools import lru_cache

from config.records.commissioning import CommissioningRecord, commissioning_inhibit
from config.schema import Configuration
from daemon.cnc.session import CncSession
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, Capability, Cnc
from models.control.state import Inhibit, InhibitCode, OperatorRequest

OPTIONAL = (
    Capability.SEQUENCE_NUMBER,
    Capability.SPINDLE_SPEED,
    Capability.MOTOR_TEMPERATURE,
    Capability.AXIS_POSITION,
)
NEEDED = tuple(name for name in Capability if name not in OPTIONAL)
"""What no axis is compensated without."""


class Interlocks:
    """Denies by default; every inhibit says what is refused, why, and what a person can do."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        commissioning: CommissioningRecord | None,
        model_problem: Callable[[], str],
        record_refused: str = "",
    ) -> None:
        """`model_problem` says why no model can be followed, `record_refused` why a record counts for nothing."""
        self._configuration = configuration
        self._clock = clock
        self._commissioning = commissioning
        self._model_problem = model_problem
        self._not_proved = lru_cache(maxsize=16)(self._judged)  # record and macros stay as they are: asked every time
        self._record_refused = record_refused
        axes = configuration.compensation.axes
        self._axes = tuple(axes)
        sequenced = configuration.compensation.reference.sequence_numbers
        sequenced = [*sequenced, *configuration.compensation.output.safe_sequence_numbers]
        self._needed = (*NEEDED, *([Capability.SEQUENCE_NUMBER] if sequenced else []))
        self.modelled = frozenset(name for name, axis in axes.items() if axis.estimate is not None)

    def inhibits(self, session: CncSession | None, axes: frozenset[str]) -> tuple[Inhibit, ...]:
        """Return what inhibits compensating these axes, the most fundamental first."""
        found = []
        if problem := self._model_problem():
            found.append(Inhibit(code=InhibitCode.MODEL, text=problem))
        if session is not None:
            guard_version = None if session.echo is None else session.echo.guard_version
            found += self._of_control(session.cnc, axes, guard_version)
        return tuple(found)

    def write_inhibit(self, cnc: Cnc) -> Inhibit | None:
        """Return why nothing at all may be written to this control, not even a retreat, None when it may."""
        return next(self._of_control(cnc, frozenset()), None)

    def _of_control(self, cnc: Cnc, axes: frozenset[str], guard_version: float | None = None) -> Iterator[Inhibit]:
        if self._clock.speed != 1.0 and cnc.identity != SIMULATED_CNC_IDENTITY:
            yield Inhibit(
                code=InhibitCode.CLOCK,
                text="the clock is simulated but the control is not",
                remedy="run without --simulated-clock",
            )
        record_file = self._configuration.compensation.commissioning_file
        if self._commissioning is None and record_file is not None:
            yield Inhibit(
                code=InhibitCode.COMMISSIONING,
                text=f"the commissioning record {record_file} was refused when the daemon started, so there is no "
                f"commissioning record: {self._record_refused}",
                remedy="mend it or run `toolpoint commission`, then start the daemon again",
            )
        if not_proved := self._not_proved(cnc.identity, axes, guard_version):
            yield Inhibit(code=InhibitCode.COMMISSIONING, text=not_proved)
        config = self._configuration.cnc
        if cnc.security == "insecure" and not config.allow_insecure_writes:
            text = "the connection is not secure"
            yield Inhibit(code=InhibitCode.SECURITY, text=text, remedy=config.insecure_advice)
        if missing := next((name for name in self._needed if name in cnc.cannot), None):
            yield Inhibit(
                code=InhibitCode.CONTROL,
                text=f"the control gives no {missing.replace('_', ' ')}: {cnc.cannot[missing]}",
                remedy="set the reference and the safe points by macro variables (cnc.macros.request, "
                "cnc.macros.safe_flag)"
                if missing is Capability.SEQUENCE_NUMBER
                else "reach the control by another driver (cnc.driver)",
            )

    def _judged(self, identity: str, axes: frozenset[str], guard_version: float | None) -> str:
        return commissioning_inhibit(
            self._commissioning,
            cnc_identity=identity,
            macros=self._configuration.cnc.macros,
            axes=sorted(axes),
            guard_version=guard_version,
            slopes=self._configuration.compensation.slopes,
            machine=self._configuration.machine,
        )

    def request_inhibit(
        self, request: OperatorRequest, session: CncSession | None, *, not_begun: str
    ) -> Inhibit | None:
        """Return why a person's request is refused, None when it may be taken; `not_begun`: why nothing has begun."""
        if not_begun:
            return Inhibit(code=InhibitCode.NOT_BEGUN, text=not_begun)
        if request.acknowledge and session is None:
            return Inhibit(
                code=InhibitCode.LINK,
                text="there is no link to the CNC, so what it holds is unknown",
                remedy="acknowledge again when the link is back",
            )
        if strange := sorted((request.enable | request.disable) - set(self._axes)):
            text = f"there is no axis {', '.join(strange)}"
            return Inhibit(code=InhibitCode.UNKNOWN_AXIS, text=text, remedy=f"axes are {', '.join(self._axes)}")
        if without := sorted(request.enable - self.modelled):
            return Inhibit(
                code=InhibitCode.MODEL,
                text=f"axis {', '.join(without)} has no model (compensation.axes.{without[0]}.estimate is not set), "
                "so it stays disabled",
            )
        return next(iter(self.inhibits(session, request.enable)), None) if request.enable else None


def in_words(request: OperatorRequest) -> str:
    """Return a request as a phrase for log and audit."""
    words = []
    if request.enable:
        words.append(f"enable {', '.join(sorted(request.enable))}")
    if request.disable:
        words.append(f"disable {', '.join(sorted(request.disable))}")
    if request.zero:
        words.append("disable all and retreat to zero")
    if request.acknowledge:
        words.append("acknowledge the fault")
    return "; ".join(words)
