"""Who and what may move the machine: everything that stands against switching an axis on."""

from collections.abc import Callable, Iterable, Iterator

from config.records.commissioning import CommissioningRecord, commissioning_obstacle
from config.schema import Configuration
from daemon.cnc.session import CncSession
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, Cnc
from models.control.state import OperatorRequest


class Interlocks:
    """Denies by default; every refusal says what was refused, why, and what a person can do."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        commissioning: CommissioningRecord | None,
        model_obstacle: Callable[[], str],
    ) -> None:
        self._configuration = configuration
        self._clock = clock
        self._commissioning = commissioning
        self._model_obstacle = model_obstacle
        axes = configuration.compensation.axes
        self._axes = tuple(axes)
        self.modelled = frozenset(name for name, axis in axes.items() if axis.estimate is not None)

    def refusals(self, session: CncSession | None, axes: frozenset[str]) -> tuple[str, ...]:
        """Return what stands against compensating these axes, the most fundamental first."""
        of_control: Iterable[str] = ()
        if session is not None:
            guard_version = None if session.echo is None else session.echo.guard_version
            of_control = self._obstacles_of_control(session.cnc, axes, guard_version)
        return tuple(obstacle for obstacle in (self._model_obstacle(), *of_control) if obstacle)

    def prohibition(self, cnc: Cnc) -> str:
        """Return why nothing at all may be written to this control, not even a retreat, '' when it may."""
        return next((obstacle for obstacle in self._obstacles_of_control(cnc, frozenset()) if obstacle), "")

    def _obstacles_of_control(
        self, cnc: Cnc, axes: frozenset[str], guard_version: float | None = None
    ) -> Iterator[str]:
        if self._clock.speed != 1.0 and cnc.identity != SIMULATED_CNC_IDENTITY:
            yield "the clock is simulated but the control is not: run without --simulated-clock"
        record_file = self._configuration.compensation.commissioning_file
        if self._commissioning is None and record_file is not None:
            yield (
                f"the commissioning record {record_file} could not be read when the daemon started, so there is no "
                "commissioning record: `toolpoint commission --check` says why; start the daemon again afterwards"
            )
        yield commissioning_obstacle(
            self._commissioning,
            cnc_identity=cnc.identity,
            macros=self._configuration.cnc.macros,
            axes=sorted(axes),
            guard_version=guard_version,
        )
        config = self._configuration.cnc
        if cnc.security == "insecure" and not config.allow_insecure_writes:
            yield f"the connection is not secure: {config.insecure_advice}"

    def objection(self, request: OperatorRequest, session: CncSession | None, *, unknown: str) -> str:
        """Return why a person's request is refused, '' when it may be taken; `unknown`: why nothing has begun."""
        if unknown:
            return unknown
        if request.acknowledge and session is None:
            return "there is no link to the CNC, so what it holds is unknown; acknowledge again when the link is back"
        if strange := sorted((request.enable | request.disable) - set(self._axes)):
            return f"there is no axis {', '.join(strange)}; axes are {', '.join(self._axes)}"
        if without := sorted(request.enable - self.modelled):
            return (
                f"axis {', '.join(without)} has no model (compensation.axes.{without[0]}.estimate is not set), "
                "so it stays disabled"
            )
        refusals = self.refusals(session, request.enable) if request.enable else ()
        return refusals[0] if refusals else ""


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
