"""What a fault campaign watches: the machine's side of each moment, and what the daemon says of itself then."""

from collections.abc import Callable, Sequence

from config.schema import Configuration
from daemon.simulation.faults.invariants import Claims, WriteWatch
from daemon.simulation.faults.models import CampaignModels
from daemon.simulation.faults.operations_check import QUIET, HeartbeatWatch, OperationsWatch, Request
from daemon.simulation.faults.recovery import CutFreeze, GoodInput, RecoveryWatch, Truth
from daemon.simulation.faults.result import Result
from daemon.simulation.faults.script import EPOCH_UTC_S, Happening, Incident
from daemon.simulation.faults.truth_watch import TruthWatch
from daemon.simulation.faults.twin import Twin
from daemon.simulation.faults.world import CampaignWorld
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.nc import RunCode
from drivers.sim.nc.program import RETREAT, campaign_program
from drivers.sim.nc.safe_point import SafePointApplication

NAMES = (
    *WriteWatch.NAMES,
    *OperationsWatch.NAMES,
    TruthWatch.NAME,
    "state_after_fault",
    "fault_is_latched",
    "changes_of_state_known",
    "heartbeat",
    "acknowledged_cycles_kept",
    "audit_complete",
    "audit_has_every_block",
    "displacements_once",
    "probes_kept",
    "nothing_unexpected",
    "memory_growth",
)
KEPT_BLOCKS = 100_000
TWIN_S = 10.0
"""The twin reads the sensors this often: as often as they convert [s]."""


TEMPERATURES_LATE_S = 25.0
"""Temperatures arrive when a line has sent a whole cycle within this time [s]."""
BLIND_BEFORE_S = 120.0
"""A reference is the mean of its last minute, and a line that sent nothing counts again half a minute later [s]."""
FADED_AFTER_S = 300.0
"""The step of a line's return has faded [s]."""
ZERO_UM = 1e-6


class TruthKeeper:
    """Sees what is on the wires and in the NC, where the daemon has only what it receives."""

    def __init__(
        self, configuration: Configuration, world: CampaignWorld, operations: OperationsWatch, models: CampaignModels
    ) -> None:
        output = configuration.compensation.output
        self._macros = configuration.cnc.macros
        self._safe, self._least = frozenset(output.safe_sequence_numbers), output.min_confidence
        self._freeze = CutFreeze(output.full_confidence)
        self._frozen = False
        self._world = world
        self._operations = operations
        self._models = models
        self._heard_s = -1e9
        self._disturbed_s = -1e9
        self._reference: str | None = None
        self._reference_s = 0.0
        self._sensor_wrong_s = -1e9
        self._blind = self._doubted = False
        self._followed = True
        self._tool, self._tool_blind = world.machine.nc.tool_number, False

    def cycle(self, time_s: float, *, whole: bool, heard: bool) -> None:
        if heard:
            self._heard_s = time_s
        if not whole:
            self._disturbed_s = time_s

    def heard(self, time_s: float, claims: Claims) -> None:
        """Take what the daemon says: was a line away when its reference was set, has confidence fallen in a cut?

        A tool that comes while a line is away may have no temperature of then; tools that were set before are in doubt
        when the work is positioned while the estimate is not followed, or a line has only just returned.
        """
        nc = self._world.machine.nc
        if nc.tool_number != self._tool:
            self._tool, self._tool_blind = nc.tool_number, time_s - self._disturbed_s <= TEMPERATURES_LATE_S
        cutting = nc.run == RunCode.START and nc.sequence_number not in self._safe
        self._frozen = self._freeze.look(claims, self._least, cutting=cutting)
        if claims.reference != self._reference:
            self._reference, self._reference_s = claims.reference, time_s
            self._blind = time_s - self._disturbed_s <= BLIND_BEFORE_S
            self._doubted |= not self._followed or time_s - self._disturbed_s <= FADED_AFTER_S
            self._tool_blind = False
        self._followed = claims.confidence >= self._least and claims.in_domain

    def begun(self, happening: Happening) -> None:
        if happening.kind in QUIET:
            self._sensor_wrong_s = max(self._sensor_wrong_s, happening.end_s + BLIND_BEFORE_S)

    def temperatures(self, time_s: float) -> bool:
        return time_s - self._heard_s <= TEMPERATURES_LATE_S

    @property
    def at_retreat_block(self) -> bool:
        """The part program waits at its retreat block."""
        nc = self._world.machine.nc
        return (nc.program, nc.sequence_number, nc.run) == (
            self._world.machine.body.program.number,
            RETREAT,
            RunCode.START,
        )

    @property
    def echo_known(self) -> bool:
        """The guard's echo of every axis can be read."""
        return None not in self._echoes()

    def _echoes(self) -> list[float | None]:
        table = self._world.machine.nc.macros
        return [table.get(number) for number in self._macros.echo_applied.values()]

    def at(self, time_s: float, claims: Claims) -> Truth:
        unit_um = self._macros.unit_um
        known = [value for value in self._echoes() if value is not None]
        return Truth(
            reachable=self._world.cnc.reachable,
            temperatures=self.temperatures(time_s),
            distrust=bool(self._world.cnc.proof),
            echo_known=self.echo_known,
            at_zero=self.echo_known and all(abs(value) * unit_um <= ZERO_UM for value in known),
            zero_first=self._operations.retreating,
            reference_blind=self._blind or self._tool_blind,
            sensor_was_wrong=self._sensor_wrong_s >= self._reference_s,
            measured_unsurely=self._sensor_wrong_s > 0.0 or self._doubted,
            tool_unnamed=self._operations.tool_unnamed,
            frozen_in_cut=self._frozen,
            model_has_states=any(map(self._models.is_watching, (claims.model, self._models.model_id))),
        )


class Observer:
    """The world of a campaign and all watches in it; implements `daemon.simulation.faults.world.Watcher`."""

    def __init__(
        self,
        configuration: Configuration,
        script: Sequence[Happening],
        models: CampaignModels,
        result: Result,
        *,
        begun: Callable[[float, Happening], None],
        ended: Callable[[Happening], None],
    ) -> None:
        """`begun` and `ended` do what an incident does to the daemon's process, its files and a person."""
        self._begun, self._ended = begun, ended
        self._models = models
        self._result = result
        self._map = configuration.cnc.macros
        machine = CfrpMachine(
            Day.draw(result.seed, start="cold"),
            campaign_program(),
            configuration.temperatures.sensors,
            SafePointApplication(self._map, configuration.compensation.axes, configuration.cnc.guard),
        )
        self.world = CampaignWorld(machine, configuration, script, self, epoch_utc_s=EPOCH_UTC_S, seed=result.seed)
        ledger = result.ledger
        self._writes = WriteWatch(configuration, ledger)
        least = configuration.compensation.output.min_confidence
        self._recovery = RecoveryWatch(ledger, least)
        self.operations = OperationsWatch(ledger, self._map.request, least)
        self._truth = TruthKeeper(configuration, self.world, self.operations, models)
        twin = Twin(configuration, models.loaded(), machine.body.sensors.ids)
        self._twins = TruthWatch(configuration, ledger, twin)
        self.world.every(TWIN_S, self._twin_reads)
        self._heart = HeartbeatWatch(self._map, ledger)
        rules = configuration.temperatures.cleansing
        self._good_input = GoodInput(
            [line.name for line in configuration.temperatures.lines],
            stale_after_s=rules.stale_after_s,
            release_after_samples=rules.release_after_samples,
        )
        self.claims: Claims | None = None
        self._heard_at_s = 0.0
        self._case_kinds: set[str] = set()
        self.follows_since_s: float | None = None
        """Since when this life of the daemon has followed the CNC; None before it does."""
        self.blocks: list[float] = []
        """Sequence numbers of the blocks that the CNC has taken in this life."""
        self.acknowledging = False
        """A person has acknowledged in this life, and no FAULT was left since."""

    def _twin_reads(self) -> None:
        machine = self.world.machine
        degc = machine.body.sensors.degc(machine.body.register_codes())
        self._twins.twin.sample(self.world.time_s, degc, machine.nc.spindle_speed_rpm, machine.nc.tool_number)

    def restarted(self, time_s: float) -> None:
        self._twins.restarted(time_s)
        self.operations.restarted(time_s)
        self._heart.disturbed(time_s)
        self._writes.restarted(time_s)
        self.follows_since_s = None
        self.acknowledging = False
        self.blocks = []

    def finish(self) -> None:
        """Bring what was measured into the result."""
        self._result.recovery_s = self._recovery.times_s
        self._result.twin_um = self._twins.worst_um

    # --- what the machine sees --------------------------------------------------------------

    def cycle(self, time_s: float, line: str, *, whole: bool, heard: bool) -> None:
        self._result.cycles += 1
        self._truth.cycle(time_s, whole=whole, heard=heard)
        if whole:
            self._good_input.cycle(line)
            self._note_good_input(time_s)

    def applied(self, time_s: float, applied_um: dict[str, float], cutting: bool) -> None:
        self._writes.applied(time_s, applied_um, cutting=cutting)
        self._twins.applied(time_s, applied_um, self.world.machine.nc.macros.get(self._map.echo_time))

    def asked(
        self, time_s: float, counter: int, kind: int, axis: int, value_mm: float, *, nonsense: bool = False
    ) -> None:
        """Take a request of the NC program, or what somebody else has put there."""
        request = Request(time_s=time_s, counter=counter, kind=kind, axis=axis, value_mm=value_mm, nonsense=nonsense)
        self.operations.asked(request)

    def begun(self, time_s: float, happening: Happening) -> None:
        self.operations.begun(time_s, happening)
        self._twins.busy(happening.end_s)
        if happening.kind is Incident.POWER_CYCLE:
            self._twins.twin.forget()
        self._truth.begun(happening)
        self._heart.disturbed(happening.end_s)
        self._result.incidents[happening.kind.value] += 1
        self._recovery.begun(happening.kind.value)
        self._case_kinds.add(happening.kind.value)
        self._begun(time_s, happening)

    def ended(self, time_s: float, happening: Happening) -> None:
        self._ended(happening)
        self.operations.ended(happening)
        self._good_input.after(happening)
        if not self.world.active:
            self._recovery.over(self._case_kinds)
            self._case_kinds = set()

    def polled(self, time_s: float) -> None:
        self.operations.polled(time_s, retreat_block=self._truth.at_retreat_block)
        self._good_input.cnc()
        self._note_good_input(time_s)

    def group(self, group: tuple[tuple[int, float], ...], *, taken: bool) -> None:
        """Take one group of a block that reached the CNC."""
        time_s = self.world.time_s
        self._writes.group(time_s, group, self.claims, taken=taken)
        if taken and group[0][0] == self._map.sequence_a:
            self._result.blocks += 1
            self.blocks.append(group[0][1])
            del self.blocks[:-KEPT_BLOCKS]
        request = self._map.request
        if taken and request is not None and group[0][0] == request.acknowledge:
            self._twins.answered(self.operations.latest, group[0][1], self._applied_um())
            self._writes.mark(time_s, self.operations.answered(time_s, group[0][1]))

    # --- what the daemon says ---------------------------------------------------------------

    def round(self, time_s: float) -> None:
        """Look at the heartbeat, and at the sensors that are wrong."""
        self.operations.round(time_s, self.claims)
        if self.claims is None:
            return
        self._heart.look(time_s, self.claims, self.world.machine.nc)
        if self._models.is_watching(self.claims.model):
            for happening in (h for h in self.world.active if h.kind is Incident.WRONG_SENSOR):
                limit_k = self._models.limit_k(int(happening.target or 0))
                self.operations.wrong_sensor(time_s, happening, self.claims, limit_k)

    def hear(self, time_s: float, claims: Claims | None) -> None:
        """Take what the daemon says of itself at a time; count how long it was in its state."""
        state = self.claims.state if self.claims is not None else "not running"
        states_s = self._result.states_s
        states_s[state] = states_s.get(state, 0.0) + max(0.0, time_s - self._heard_at_s)
        self._heard_at_s = max(time_s, self._heard_at_s)
        before = self.claims
        self.claims = claims
        if claims is None:
            self._twins.heard(time_s, None, self._applied_um, disturbed=True)
            return
        if self.follows_since_s is None:
            self.follows_since_s = time_s
        if before is not None and before.state == "FAULT" and claims.state != "FAULT":
            self.world.cnc.forgiven()
            self._recovery.left_fault(time_s, acknowledged=self.acknowledging)
            self.acknowledging = False
        self._writes.heard(time_s, claims)
        self._truth.heard(time_s, claims)
        self.operations.heard(time_s, claims, self._applied_um)
        self._twins.heard(time_s, claims, self._applied_um, disturbed=bool(self.world.active))
        self._writes.input_is(time_s, good=self._truth.temperatures(time_s), echo_known=self._truth.echo_known)
        self._note_good_input(time_s)
        if self._recovery.open:
            self._recovery.look(time_s, self._truth.at(time_s, claims), claims)

    def _applied_um(self) -> dict[str, float]:
        return self.world.machine.guard.applied_um

    def _note_good_input(self, time_s: float) -> None:
        """Begin to count when the first good input has arrived; what the daemon claims is still from before it."""
        if self.claims is not None and self._recovery.waiting and self._good_input.there:
            self._recovery.good_input(time_s, self.claims)
