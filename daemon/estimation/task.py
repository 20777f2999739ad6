"""The thermal task: cycles in, cleansed temperatures and the estimate out.

One task owns the cleansing state, the one-minute means and the reference temperatures; whoever
wants something of it puts a message into `inbox`.
"""

import asyncio
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np
import structlog

from config.schema import Configuration
from config.schema.temperatures import TemperaturesConfig
from daemon.estimation.cleansing import NAMED, Cleansing
from daemon.estimation.inputs import Delivery, Message, NoPositions
from daemon.estimation.model_in_use import History, ModelInUse
from daemon.estimation.rebuild import HistoryBackfill
from daemon.estimation.sensor_memory import LevelMemory, Places, SinceReference
from daemon.history.writer import HistoryWriter
from daemon.messages import (
    EstimateComing,
    ReferenceEnded,
    ReferenceRebased,
    ReferenceRefused,
    ReferenceRequest,
    ReferenceTakenUp,
    SensorsSinceReference,
    SpindleSpeed,
    TemperaturesTrusted,
)
from daemon.rate_limit import RateLimit
from daemon.snapshots import ThermalSnapshot
from daemon.state_store.store import StateStore
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.align import RollingMean
from models.records import FloatArray, Instant, MachineTemperatures, Reference, TemperatureCycle, ThermalErrorEstimate
from models.sensor_levels import UNKNOWN_K, unshifted
from models.thermal.estimation import UNSURE_UM, Estimation, Machine
from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray
from models.thermal.watch import DEPARTURE

log = structlog.get_logger(__name__)
TURNS_OF_OUTPUT = 4
"""The loop turns so often until the control task has the answer to its look ahead and has sent its first write."""


def _open_positions(configuration: Configuration) -> NoPositions:
    """Return what is known of the axis positions of this machine."""
    if not configuration.cnc.axis_positions:
        return NoPositions()
    from daemon.estimation.axis_positions import AxisPositions  # noqa: PLC0415 (loaded only where it is configured)

    return AxisPositions(configuration)


SAME_CONFIDENCE = 1e-3
"""A model whose confidence is lower by more counts for less."""


class ThermalTask:
    """Cleanses every completed line cycle and renews the estimate with it."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        history: HistoryWriter,
        telemetry: Telemetry,
        model: ThermalModel | None,
        inbox: "asyncio.Queue[Message]",
        deliver: Callable[[Delivery], None],
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        temperatures = configuration.temperatures
        self._clock, self._history, self._telemetry = clock, history, telemetry
        self._deliver, self._on_change, self.inbox = deliver, on_change, inbox
        self._temperature_is_shown = _temperature_is_shown(configuration)
        self._labels = {label: np.array(indices) for label, indices in temperatures.labels.items()}
        self._sensor_ids = temperatures.sensor_ids
        self._cleansing = Cleansing(configuration, clock)
        self._reference: Reference | None = None
        self.latest_estimate: ThermalErrorEstimate | None = None
        self.cycles_received = self.cycles_incomplete = self.estimates = 0
        self.line_faults: dict[str, tuple[str, ...]] = {}
        self._speed = RollingMean(configuration.compensation.reference.mean_s)
        self._speed_at_s = self._taken_up_s = -np.inf
        self._positions = _open_positions(configuration)
        self._past = HistoryBackfill(configuration, clock, self._positions, StateStore(history, clock))
        self._in_use = partial(_in_use, self._past, self._cleansing, temperatures, self._positions)
        self._online = self._in_use(model)
        self._next: ModelInUse | None = None  # waits for an estimate to go on from, or a reference
        self._gave_way: dict[str, ModelInUse] = {}  # at a newer reference, by the one that it counts from
        self._follows: tuple[str, FloatArray] | None = None  # see ThermalErrorEstimate
        self._since = SinceReference(self._sensor_ids, self._labels)
        self._wrong_before = partial(_wrong_before, self._cleansing, self._since, self._sensor_ids)
        self._levels = LevelMemory(history, configuration.reads, clock)
        self._cleansing.levels, self._since.excluded = self._levels.restored(), self._levels.excluded_before()
        self._cleansing.units.recall(self._levels.units)
        self._cleansing.memory.recall(self._levels.inputs)
        self._tool_um_per_k, self._heard = _tool_um_per_k(configuration), np.zeros(len(self._sensor_ids), dtype=bool)
        self._say_faults = RateLimit[TemperatureCycle](_log_faults)

    @property
    def latest(self) -> MachineTemperatures | None:
        return self._cleansing.latest

    async def run(self) -> None:
        await self.begin()
        while True:
            item = await self.inbox.get()
            try:
                await self._take(item)
            except Exception:
                log.exception("thermal.defect")  # the output goes on: without estimates it holds, and says so
                if isinstance(item, ReferenceRequest):
                    why = f"reference of {item.source} refused: its temperatures could not be taken, see the log"
                    self._deliver(ReferenceRefused(reference_id=item.reference_id, why=why))
            self._on_change()

    async def begin(self) -> None:
        """Take from the store what it gives; the rest is unknown, which the estimates say."""
        for step in (self.recall, self._prepare):
            try:
                await step()
            except Exception:
                log.exception("thermal.defect")

    async def recall(self) -> None:
        degc, at_s, read = await asyncio.to_thread(self._past.last_accepted)
        degc[self._levels.anew], at_s[self._levels.anew] = np.nan, -np.inf
        self._cleansing.recall(degc, at_s, read)

    async def _prepare(self) -> None:
        if self._online is not None:
            await asyncio.to_thread(self._online.prepare, self._clock.now().monotonic_s, self._wrong_before())

    async def _take(self, item: Message) -> None:
        if isinstance(item, TemperatureCycle):
            await self._on_cycle(item)
        elif isinstance(item, SpindleSpeed):
            self._speed.add(item.monotonic_s, np.array([item.rpm]))
            self._speed_at_s = item.monotonic_s
            self._positions.take(item)
        elif isinstance(item, ReferenceEnded):
            if item.for_good and self._reference is not None and self._reference.reference_id == item.reference_id:
                self._reference = None
        elif isinstance(item, ReferenceRequest):
            self._set_reference(item)
        elif isinstance(item, ReferenceTakenUp):
            if self._reference is None or self._reference.reference_id != item.reference.reference_id:  # it was left
                await self._take_up(item.reference, item.sensors)
        elif isinstance(item, TemperaturesTrusted):
            self._cleansing.trust_temperatures()
            log.info("temperatures.trusted", person=item.person)
        else:
            await self.use_model(item)

    async def _take_up(self, reference: Reference, sensors: SensorsSinceReference | None) -> None:
        """Go on from a reference of before; what the model needs of the store is read in a thread."""
        self._taken_up_s = self._clock.now().monotonic_s
        self._cleansing.count_again_from(reference.reference_id, reference.time.monotonic_s)
        self._since.take_up(reference, sensors)
        self._positions.take_up(self._since.positions_mm)
        before, now = self._gave_way.get(reference.reference_id), self._online
        if before is not None and now is not None:  # the reference at which it gave way was refused
            self._online, self._reference = before, reference
            await self.use_model(now.model)
        elif now is not None:
            await self._count_from_reference(now, reference, self._taken_up_s, {})
        self._reference = reference

    async def use_model(self, model: ThermalModel | None, *, at_once: bool = False) -> None:
        """Estimate with it from the next cycle on, continuously; `at_once`: the one in use, whose past has changed."""
        if (online := self._in_use(model)) is not None:
            now_s = self._clock.now().monotonic_s
            await asyncio.to_thread(online.prepare, now_s, wrong := self._wrong_before())
            if self._reference is not None:
                await self._count_from_reference(online, self._reference, now_s, {} if at_once else wrong)
        at_once = at_once or self._online is None or online is None or self._reference is None
        self._online, self._next = (online, None) if at_once else (self._online, online)
        self._follows, self._gave_way = None if at_once else self._follows, {}

    async def _count_from_reference(self, to: ModelInUse, at: Reference, now_s: float, wrong: dict[int, str]) -> None:
        known = (wrong | self._since.excluded, self._since.of_model, self._positions.at_reference(at.degc))
        await asyncio.to_thread(to.set_reference, at, now_s, *known)

    def inhibit(self) -> str:
        """Return why the model cannot be followed yet, '' when it can or when there is none."""
        if self._online is None:
            return ""
        unknown = self._positions.unknown(self._online.model, self._clock.now().monotonic_s)
        return unknown or self._online.inhibit(self._cleansing.window_s, self._cleansing.least)

    async def _on_cycle(self, cycle: TemperatureCycle) -> None:
        """Hand the estimate on first: the control task looks ahead while it is made, and writes before the history."""
        if self._online is not None and self._reference is not None:
            self._deliver(EstimateComing(line=cycle.line))
            await asyncio.sleep(0)
        temperatures = self._cleansing.on_cycle(cycle)
        if (jumped_k := self._cleansing.jumped_k) is not None:
            for each in filter(None, (self._online, self._next)):
                each.jumped(jumped_k)
        models = [each for each in (self._online, self._next) if each is not None]
        if self._past.calendar_set(max((each.memory_s for each in models), default=0.0)) or self._cleansing.gap_ended:
            for place, each in enumerate(models):
                await self.use_model(each.model, at_once=place == 0)
        units, inputs = self._cleansing.units.found, self._cleansing.memory.kept
        self._levels.keep(self._cleansing.levels, self._since.excluded, units, inputs)
        self.cycles_received += 1
        self._telemetry.arrived(cycle)
        renewed = self._estimate(temperatures)
        known = (self.latest_estimate, renewed, self._cleansing, self._positions, self._reference, self._since.absent)
        if self._next is not None and not _waits_for(self._next, *known):
            self._online, self._next = self._next, None
            before, renewed = renewed, self._estimate(temperatures)
            if before is not None and renewed is not None:
                self._follows = _more(before, renewed)
                renewed = replace(renewed, follows=self._follows)
        if renewed is not None:
            self.latest_estimate = renewed
            self.estimates += 1
            self._deliver(renewed)
            self._since.tell(self._deliver)
        if self._temperature_is_shown:
            self._deliver(self._cleansing.believed(temperatures, self._since.excluded))
        await _turns(TURNS_OF_OUTPUT)
        if renewed is not None:
            self._history.estimate(renewed)
        self._history.temperatures(temperatures, cycle)
        self._telemetry.cycle(cycle)
        self.cycles_incomplete += not cycle.complete
        if cycle.faults != self.line_faults.get(cycle.line, ()):
            self.line_faults[cycle.line] = cycle.faults
            self._say_faults(cycle)

    def _estimate(self, temperatures: MachineTemperatures) -> ThermalErrorEstimate | None:
        degc = self._cleansing.counted_degc(self._since.absent, self._reference)
        now_s = temperatures.trace.first_byte.monotonic_s
        speed_rpm = float(self._speed.mean()[0]) if now_s - self._speed_at_s <= self._speed.window_s else np.nan
        online, reference = self._online, self._reference
        if online is None:
            return None
        inputs = self._positions.behind(degc, clock_s := self._clock.now().monotonic_s)
        for each in filter(None, (online, self._next)):
            each.on_sample(now_s, inputs, speed_rpm)
        self._heard |= np.isfinite(degc)
        taken_up = now_s - self._taken_up_s <= self._cleansing.stale_after_s
        if reference is None or (taken_up and self._since.waits_for_sensors(reference, online.places, self._heard)):
            return None
        if (answer := online.estimate(reference, now_s, inputs, self._since.absent)) is None:
            return None
        outcome, counted = answer
        if counted is not reference:
            self._reference = counted
            self._deliver(ReferenceRebased(reference=counted))
        reference, model, um_per_k = counted, online.model, self._tool_um_per_k
        unsure, uncertainty_k = self._since.wrong_in_tool(degc, um_per_k), self._cleansing.levels.uncertainty_k
        unsure = unsure or self._cleansing.withheld(degc, outcome.share, online.excluded)
        unsure = unsure or _unsure(outcome, online, uncertainty_k, um_per_k, self._sensor_ids)
        of_positions, untrusted = self._positions.trust(model, clock_s, outcome.imputed)
        unsure, confidence = unsure or untrusted, outcome.confidence * of_positions
        followed = not unsure and outcome.in_domain and confidence >= self._cleansing.least
        goes_on_um = self._since.goes_on_um(model, outcome.imputed, outcome.thermal_error_um, now_s / 60.0, followed)
        self._since.update(degc, online, outcome.found_wrong_um)
        increments_k = self._since.label_increments(degc, now_s / 60.0)
        return ThermalErrorEstimate(
            channels=model.channels,
            thermal_error_um=goes_on_um,
            band_um=model.band_um * outcome.band_factor,
            label_degc=_label_means(self._labels, degc),
            label_increment_degc=_believed(increments_k, self._labels, uncertainty_k * um_per_k),
            in_domain=outcome.in_domain,
            confidence=0.0 if unsure else confidence,
            imputed=tuple(outcome.imputed),
            fading_um=self._since.fading_um(model.channels, now_s / 60.0, um_per_k),
            found_wrong_um=self._since.found_wrong_um,
            inhibit=self.inhibit() or unsure,
            held_s=self._cleansing.held_s(degc, now_s, set(outcome.imputed)),
            model_id=model.model_id,
            reference_id=reference.reference_id,
            line=temperatures.line,
            trace=replace(temperatures.trace, estimated=self._clock.now()),
            probe_wander=None if model.probing is None else (model.probing.um2_per_min, model.probing.correlation_min),
            follows=self._follows,
        )

    def _set_reference(self, request: ReferenceRequest) -> None:
        now = self._clock.now()
        degc = _due_degc(self._cleansing, now.monotonic_s)
        usable = int(np.isfinite(degc).sum())
        if why := self._cleansing.refusal(usable, now.monotonic_s):
            why = f"reference of {request.source} refused: {why}"
            self._deliver(ReferenceRefused(reference_id=request.reference_id, why=why))
            return
        self._gave_way = _gives_way(self._online, self._next, self._reference) or self._gave_way
        self._reference = reference = _reference(request, now, degc)
        self._online, self._next, self._follows, self._taken_up_s = self._next or self._online, None, None, -np.inf
        self._cleansing.trust_anew(reference.reference_id, self._since.excluded)
        self._since.begin(reference)
        self._since.positions_mm = self._positions.set_reference(now.monotonic_s)
        if self._online is not None:
            inputs, levels = self._positions.at_reference(degc), self._cleansing.levels
            self._online.set_reference(reference, now.monotonic_s, inputs=inputs, levels=levels)
        log.info("reference.set", source=request.source, sensors=usable, of=len(degc))
        self._deliver(reference)
        if self.latest is not None and (first := self._estimate(self.latest)) is not None:
            self.latest_estimate = first = replace(first, trace=replace(first.trace, cleansed=None))
            self._deliver(first)
            self._since.tell(self._deliver)


def thermal_snapshot(thermal: ThermalTask) -> ThermalSnapshot:
    online, following = thermal._online, thermal._next
    waits = f"{following.model.model_id} makes no estimates yet: {following.waits}" if following is not None else ""
    return ThermalSnapshot(
        temperatures=thermal.latest,
        estimate=thermal.latest_estimate,
        line_faults=MappingProxyType(dict(thermal.line_faults)),
        cycles_received=thermal.cycles_received,
        cycles_incomplete=thermal.cycles_incomplete,
        estimates=thermal.estimates,
        model_waits=waits,
        contributions=online.contributions() if online is not None and thermal.latest_estimate is not None else None,
    )


def _in_use(
    past: HistoryBackfill,
    cleansing: Cleansing,
    temperatures: TemperaturesConfig,
    positions: NoPositions,
    model: ThermalModel | None,
) -> ModelInUse | None:
    if model is None:
        return None
    sensor_ids, history = temperatures.sensor_ids, _means_of(past, cleansing, len(temperatures.sensor_ids))
    return ModelInUse(model, sensor_ids, _machine(temperatures), history, positions.names)


def _means_of(past: HistoryBackfill, cleansing: Cleansing, count: int) -> History:
    """Return what reads the means of a machine with so many sensors from its store, as their levels count now."""

    def means(from_s: float, to_s: float, period_s: float) -> Iterator[tuple[float, FloatArray, float]]:
        levels = cleansing.levels
        for time_s, row, speed_rpm in past.means(from_s, to_s, period_s):
            degc = unshifted(levels, time_s, row[:count], to_s, period_s)
            yield time_s, np.concatenate([degc, row[count:]]) if len(row) > count else degc, speed_rpm

    return means


def _gives_way(
    online: ModelInUse | None, following: ModelInUse | None, reference: Reference | None
) -> dict[str, ModelInUse]:
    """Return which model gives way to one that waits, by the reference that it counts from; empty where none does."""
    if online is None or following is None or reference is None:
        return {}
    return {reference.reference_id: online}


def _due_degc(cleansing: Cleansing, now_s: float) -> FloatArray:
    """Return the means of now [degC]; empty where no cycle has come in time."""
    latest_s = -np.inf if cleansing.latest is None else cleansing.latest.trace.first_byte.monotonic_s
    return cleansing.mean_degc() if now_s - latest_s <= cleansing.due_s else np.empty(0)


def _reference(request: ReferenceRequest, now: Instant, degc: FloatArray) -> Reference:
    return Reference(
        reference_id=request.reference_id,
        time=now,
        source=request.source,
        degc=degc,
        program=request.program,
        work_offset=request.work_offset,
        power_on_count=request.power_on_count,
    )


def _temperature_is_shown(configuration: Configuration) -> bool:
    return configuration.cnc.temperature_macro is not None or configuration.spindle_speed is not None


async def _turns(count: int) -> None:
    """Let every other task go on, so many times."""
    for _ in range(count):
        await asyncio.sleep(0)


def _more(before: ThermalErrorEstimate, after: ThermalErrorEstimate) -> tuple[str, FloatArray]:
    """Return the model before, and how much more it makes of the same temperatures than the one after it [um]."""
    known = dict(zip(before.channels, before.thermal_error_um, strict=True))
    then_um = np.array([known.get(channel, np.nan) for channel in after.channels])
    return before.model_id, then_um - after.thermal_error_um


def _waits_for(
    to: ModelInUse,
    before: ThermalErrorEstimate | None,
    renewed: ThermalErrorEstimate | None,
    cleansing: Cleansing,
    positions: NoPositions,
    reference: Reference | None,
    absent: BoolArray,
) -> str:
    """Note and return why another model does not go on from this estimate yet, '' when it may."""
    if before is None or renewed is None or reference is None:
        to.waits = "no estimate is made that it could go on from"
        return to.waits
    now_s = renewed.trace.first_byte.monotonic_s
    same = (before.reference_id, before.imputed) == (renewed.reference_id, renewed.imputed)
    trusted = all(each.in_domain and each.confidence >= cleansing.least for each in (before, renewed))
    trusted = trusted and positions.trust(to.model, now_s, ())[0] >= cleansing.least
    if not trusted:
        to.waits = "the estimate that it would go on from is not trusted"
    elif to.drifted_before(cleansing.levels.jumps, reference.time.monotonic_s):
        to.waits = "a sensor has jumped, perhaps back to the truth, before the work was positioned: position it again"
    elif renewed.held_s > 0.0:
        to.waits = f"a sensor that counts has been silent for {renewed.held_s:.0f} s"
    elif cleansing.jumped_k is not None or not same or renewed.fading_um > UNSURE_UM / 2:
        to.waits = "sensors have just left, returned or jumped, or the work was positioned"
    elif now_s - before.trace.first_byte.monotonic_s > cleansing.window_s / 2:
        to.waits = "no temperatures came for a while"
    else:
        inputs = positions.behind(cleansing.counted_degc(absent, reference), now_s)
        answer = to.estimate(reference, now_s, inputs, absent)
        worth = 0.0 if answer is None else answer[0].confidence * positions.trust(to.model, now_s, ())[0]
        less = worth < min(renewed.confidence, cleansing.full) - SAME_CONFIDENCE
        to.waits = "less is known of what it counts from than of what the model in use does" if less else ""
        if answer is not None and answer[0].imputed_um > UNSURE_UM:  # which would stay when the sensor is back
            to.waits = "what it imputes for sensors that are away may be more than 1 um off"
    return to.waits


def _wrong_before(cleansing: Cleansing, since: SinceReference, sensor_ids: tuple[int, ...]) -> dict[int, str]:
    """Return who was found wrong until a reference: lags from the history hold that until they are set right."""
    places = np.flatnonzero(cleansing.levels.lasting_k > UNKNOWN_K / 2)
    return {sensor_ids[place]: DEPARTURE for place in places} | since.excluded


def _machine(temperatures: TemperaturesConfig) -> Machine:
    components = dict(zip(temperatures.sensor_ids, temperatures.components, strict=True))
    return Machine(components=components, steps_k=temperatures.steps_k)


def _tool_um_per_k(configuration: Configuration) -> FloatArray:
    """Return by how much the tool term goes with each sensor, of the axis where that is most [um/K]."""
    labels, count = configuration.temperatures.labels, len(configuration.temperatures.sensor_ids)
    most = np.zeros(count)
    for axis in configuration.compensation.axes.values():
        if (term := axis.tool_term) is None:
            continue
        of_axis = np.zeros(count)
        for label, weight in term.temperatures.items():
            places = np.array(labels[label])
            of_axis[places] += abs(term.expansion_um_per_m_k * term.length_mm * 1e-3 * weight) / len(places)
        most = np.maximum(most, of_axis)
    return most


def _log_faults(cycle: TemperatureCycle, left_out: int) -> None:
    event = "cycle.faults" if cycle.complete else "cycle.incomplete"
    more = {"left_out": left_out} if left_out else {}
    log.warning(event, line=cycle.line, number=cycle.number, faults=cycle.faults[:5] or "none any more", **more)


def _unsure(
    outcome: Estimation,
    online: ModelInUse,
    uncertainty_k: FloatArray,
    tool_um_per_k: FloatArray,
    sensor_ids: tuple[int, ...],
) -> str:
    """Return why the estimate may be wrong by more than is allowed since its reference, '' when it may not."""
    if outcome.speed_unread_um > UNSURE_UM:
        return (
            "spindle speed was not read for a while, since the reference or shortly before it, which may be worth more "
            f"than {UNSURE_UM:g} um: position the work again half an hour after it was"
        )
    level_um = 0.0
    if uncertainty_k.any():
        level_um = online.level_um(uncertainty_k) + float(np.abs(uncertainty_k) @ tool_um_per_k)
    if level_um + outcome.imputed_um <= UNSURE_UM:
        return ""
    if outcome.imputed_um > level_um:
        named = ", ".join(f"sensor {sensor_id}" for sensor_id in outcome.imputed[:NAMED]) or "one that is back"
        named += f" and {len(outcome.imputed) - NAMED} more" if len(outcome.imputed) > NAMED else ""
        return (
            f"what the other sensors say in place of {named} may be {outcome.imputed_um:.1f} um off since the "
            "reference: bring back what is missing, and if it still holds then, position the work again"
        )
    worst = sorted(np.flatnonzero(uncertainty_k), key=lambda i: -abs(uncertainty_k[i]))[:NAMED]
    named = ", ".join(f"sensor {sensor_ids[i]} by {abs(uncertainty_k[i]):.1f} K" for i in worst)
    return (
        f"the level of {named} has changed since the reference and nothing explains it, which may be "
        f"{level_um + outcome.imputed_um:.1f} um: position the work again"
    )


def _believed(
    increments_k: dict[str, float], labels: Mapping[str, Places], uncertainty_um: FloatArray
) -> dict[str, float]:
    """Return the labels' increments without those of labels whose sensors' levels are in doubt."""
    if not uncertainty_um.any():
        return increments_k
    return {label: k for label, k in increments_k.items() if np.abs(uncertainty_um[labels[label]]).sum() <= UNSURE_UM}


def _label_means(labels: Mapping[str, Places], degc: FloatArray) -> dict[str, float]:
    means = {}
    for label, indices in labels.items():
        known = degc[indices]
        total = float(known.sum())
        if not math.isfinite(total):
            known = known[np.isfinite(known)]
            total = float(known.sum())
        if known.size:
            means[label] = total / known.size
    return means
