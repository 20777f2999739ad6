"""Keeps what is true on the machine's side of a fault campaign."""

from config.schema import Configuration
from daemon.simulation.faults.invariants import Claims
from daemon.simulation.faults.models import CampaignModels
from daemon.simulation.faults.operations_check import QUIET, OperationsWatch
from daemon.simulation.faults.recovery import CutFreeze, Truth
from daemon.simulation.faults.script import Happening
from daemon.simulation.faults.world import CampaignWorld
from drivers.sim.nc.nc import RunCode
from drivers.sim.nc.program import RETREAT

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
    def applied_um(self) -> float:
        """The largest amount that the NC applies on an axis [um]."""
        return max(map(abs, self._world.machine.guard.applied_um.values()), default=0.0)

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
