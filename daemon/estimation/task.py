"""The thermal task: cycles in, cleansed temperatures and the estimate out.

One task owns the cleansing state, the one-minute means and the reference temperatures; whoever
wants something of it puts a message into `inbox`.
"""

import asyncio
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import structlog

from config.schema import Configuration
from daemon.estimation.increments import IncrementsOnLine
from daemon.estimation.lagged import LagsOnLine
from daemon.estimation.online_model import OnLineModel
from daemon.estimation.rebuild import Past
from daemon.estimation.sensor_memory import SinceReference
from daemon.history.writer import HistoryWriter
from daemon.messages import ReferenceEnded, ReferenceRebased, ReferenceRefused, ReferenceRequest, SpindleSpeed
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.align import RollingMean
from models.cleanse import CleansingRules, CleansingState, age_s, cleanse_cycle, initial_state
from models.quality import Quality, Reason
from models.records import (
    FloatArray,
    MachineTemperatures,
    Reference,
    TemperatureCycle,
    ThermalErrorEstimate,
)
from models.thermal.family import AnyThermalModel
from models.thermal.lagged_model import LaggedModel
from models.thermal.model import ThermalModel

log = structlog.get_logger(__name__)


Message = TemperatureCycle | SpindleSpeed | ReferenceRequest | ReferenceEnded | Reference | AnyThermalModel
"""What the thermal task takes."""


Delivery = ThermalErrorEstimate | Reference | ReferenceRebased | ReferenceRefused | MachineTemperatures
"""What it gives."""


class ThermalTask:
    """Cleanses every completed line cycle and renews the estimate with it."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        history: HistoryWriter,
        telemetry: Telemetry,
        model: AnyThermalModel | None,
        inbox: "asyncio.Queue[Message]",
        deliver: Callable[[Delivery], None],
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        temperatures = configuration.temperatures
        self._clock = clock
        self._history = history
        self._telemetry = telemetry
        self._deliver = deliver
        self._on_change = on_change
        self._temperature_is_shown = configuration.cnc.temperature_macro is not None or (
            configuration.spindle_speed is not None
        )
        self._labels = {label: np.array(indices) for label, indices in temperatures.labels.items()}
        position = {sensor_id: index for index, sensor_id in enumerate(temperatures.sensor_ids)}
        self._sensor_ids = temperatures.sensor_ids
        self._components = temperatures.components
        self._lines = {
            line.name: (np.array([position[i] for i in line.sensor_ids]), line.cycle_period_s)
            for line in temperatures.lines
        }
        self._rules = CleansingRules(**temperatures.cleansing.model_dump())
        self._state: CleansingState = initial_state(len(position))
        self._mean = RollingMean(configuration.compensation.reference.mean_s)
        self._measured = np.full(len(position), np.nan)
        self._quality = np.full(len(position), Quality.MISSING, dtype=np.uint8)
        self._reason = np.full(len(position), Reason.NOT_RECEIVED, dtype=np.uint8)
        self._reference: Reference | None = None
        self.inbox = inbox
        self.latest: MachineTemperatures | None = None
        self.latest_estimate: ThermalErrorEstimate | None = None
        self.cycles_received = 0
        self.line_faults: dict[str, tuple[str, ...]] = {}
        self.cycles_incomplete = 0
        self.estimates = 0
        self._position = position
        self._speed = RollingMean(configuration.compensation.reference.mean_s)
        self._speed_at_s = -np.inf
        self._online = self._on_line(model)
        self._since = SinceReference(history, self._sensor_ids, self._labels)
        self._heard = np.zeros(len(position), dtype=bool)
        self._taken_up_s = -np.inf

    @property
    def usable(self) -> int:
        """How many sensors have a value that may be used."""
        return 0 if self.latest is None else int(np.isfinite(self.latest.degc).sum())

    async def run(self) -> None:
        """Serve the inbox for ever."""
        await self.recall()
        if self._online is not None:
            await asyncio.to_thread(self._online.prepare, self._clock.now().monotonic_s)
        while True:
            item = await self.inbox.get()
            try:
                await self._take(item)
            except Exception:
                # A defect here must not stop the output: without estimates it holds, and says so.
                log.exception("thermal.defect")
            self._on_change()

    async def recall(self) -> None:
        """Hold the first temperatures against those that the previous run accepted last."""
        past = Past(self._history.path, self._sensor_ids, self._clock)
        degc, at_s = await asyncio.to_thread(past.last_accepted)
        self._state = initial_state(len(degc), degc, at_s)

    async def _take(self, item: Message) -> None:
        if isinstance(item, TemperatureCycle):
            await self._on_cycle(item)
        elif isinstance(item, SpindleSpeed):
            self._speed.add(item.monotonic_s, np.array([item.rpm]))
            self._speed_at_s = item.monotonic_s
        elif isinstance(item, ThermalModel | LaggedModel):
            await self.use_model(item)
        elif isinstance(item, ReferenceEnded):
            if item.for_good and self._reference is not None and self._reference.reference_id == item.reference_id:
                self._reference = None
        elif isinstance(item, ReferenceRequest):
            self._set_reference(item)
        else:
            await self._take_up(item)

    async def _take_up(self, reference: Reference) -> None:
        """Go on from a reference of before; what the store knows of it is read while everybody else goes on."""
        self._taken_up_s = self._clock.now().monotonic_s
        await asyncio.to_thread(self._since.take_up, reference)
        if self._online is not None:
            known = (self._since.excluded, self._since.of_model)
            await asyncio.to_thread(self._online.refer, reference, self._taken_up_s, *known)
        self._reference = reference

    async def use_model(self, model: AnyThermalModel | None) -> None:
        """Estimate with this model from the next cycle on; the output task keeps a change of model continuous."""
        online = self._on_line(model)
        if online is not None:
            now_s = self._clock.now().monotonic_s
            await asyncio.to_thread(online.prepare, now_s)
            if self._reference is not None:
                known = (self._since.excluded, self._since.of_model)
                await asyncio.to_thread(online.refer, self._reference, now_s, *known)
        self._online = online

    def _on_line(self, model: AnyThermalModel | None) -> OnLineModel | None:
        if isinstance(model, LaggedModel):
            past = Past(self._history.path, self._sensor_ids, self._clock)
            return LagsOnLine(model, self._position, past.means)
        return IncrementsOnLine(model, self._position, self._components) if model is not None else None

    def obstacle(self) -> str:
        """Return why the model cannot be followed yet, '' when it can or when there is none."""
        if self._online is None:
            return ""
        model = self._online.model
        if isinstance(model, LaggedModel) and abs(model.period_min * 60.0 - self._mean.window_s) > 1e-6:
            return (
                f"model {model.model_id} was fitted on means over {model.period_min * 60.0:g} s; "
                f"set compensation.reference.mean_s: {model.period_min * 60.0:g}"
            )
        return self._online.obstacle()

    async def _on_cycle(self, cycle: TemperatureCycle) -> None:
        """Hand the estimate on first; the control task writes while the books are kept."""
        temperatures = self._cleanse(cycle)
        self.latest = temperatures
        self.cycles_received += 1
        self._telemetry.arrived(cycle)
        renewed = self._estimate(temperatures)
        if renewed is not None:
            self.latest_estimate = renewed
            self.estimates += 1
            self._deliver(renewed)
        if self._temperature_is_shown:
            self._deliver(temperatures)
        await asyncio.sleep(0)
        if renewed is not None:
            self._history.estimate(renewed)
        self._history.temperatures(temperatures, cycle)
        self._telemetry.cycle(cycle)
        self.cycles_incomplete += not cycle.complete
        if cycle.faults != self.line_faults.get(cycle.line, ()):
            self.line_faults[cycle.line] = cycle.faults
            event = "cycle.faults" if cycle.complete else "cycle.incomplete"
            log.warning(event, line=cycle.line, number=cycle.number, faults=cycle.faults[:5] or "none any more")

    def _cleanse(self, cycle: TemperatureCycle) -> MachineTemperatures:
        indices, period_s = self._lines[cycle.line]
        now_s = cycle.trace.first_byte.monotonic_s
        result = cleanse_cycle(
            self._rules, self._state, indices, cycle.degc, cycle.quality, cycle.reason, now_s, period_s
        )
        self._state = result.state
        self._measured[indices] = cycle.degc
        degc = self.latest.degc.copy() if self.latest is not None else np.full(len(self._measured), np.nan)
        degc[indices] = result.degc
        self._quality[indices] = result.quality
        self._reason[indices] = result.reason
        ages_s = age_s(self._state, now_s)
        stale = ages_s > self._rules.stale_after_s
        degc[stale] = np.nan
        unsaid = stale & (self._quality != Quality.MISSING)
        self._quality[unsaid], self._reason[unsaid] = Quality.MISSING, Reason.STALE
        self._mean.add(now_s, degc)
        return MachineTemperatures(
            line=cycle.line,
            measured_degc=self._measured.copy(),
            degc=degc,
            quality=self._quality.copy(),
            reason=self._reason.copy(),
            age_s=ages_s,
            trace=replace(cycle.trace, cleansed=self._clock.now()),
        )

    def _estimate(self, temperatures: MachineTemperatures) -> ThermalErrorEstimate | None:
        degc, now_s = self._mean.mean(), temperatures.trace.first_byte.monotonic_s
        speed_rpm = float(self._speed.mean()[0]) if now_s - self._speed_at_s <= self._speed.window_s else np.nan
        online, reference = self._online, self._reference
        if online is None:
            return None
        online.take(now_s, degc, speed_rpm)
        self._heard |= np.isfinite(degc)
        if reference is None or self._waits_for_sensors(online, reference, now_s):
            return None
        answer = online.estimate(reference, now_s, degc, self._since.absent)
        if answer is None:
            return None
        outcome, counted = answer
        if counted is not reference:
            self._reference = counted
            self._deliver(ReferenceRebased(reference=counted))
        reference, model = counted, online.model
        since_labels = self._since.label_increments(degc)
        self._since.keep(degc, online)
        return ThermalErrorEstimate(
            channels=model.channels,
            thermal_error_um=outcome.thermal_error_um,
            band_um=model.band_um * outcome.band_factor,
            label_degc=self._label_means(degc),
            label_increment_degc=since_labels,
            in_domain=outcome.in_domain,
            confidence=outcome.confidence,
            imputed=tuple(outcome.imputed),
            doubt=self.obstacle(),
            model_id=model.model_id,
            reference_id=reference.reference_id,
            line=temperatures.line,
            trace=replace(temperatures.trace, estimated=self._clock.now()),
        )

    def _waits_for_sensors(self, online: OnLineModel, reference: Reference, now_s: float) -> bool:
        """Whether sensors that counted before a restart have not spoken yet: none of them has left for that."""
        if now_s - self._taken_up_s > self._rules.stale_after_s:
            return False
        needed = np.zeros(len(self._heard), dtype=bool)
        for places in (*self._labels.values(), np.array([self._position[i] for i in online.model.sensor_ids])):
            needed[places] = True
        return bool((needed & np.isfinite(reference.degc) & ~self._since.absent & ~self._heard).any())

    def _label_means(self, degc: FloatArray) -> dict[str, float]:
        means = {}
        for label, indices in self._labels.items():
            known = degc[indices]
            known = known[np.isfinite(known)]
            if known.size:
                means[label] = float(known.mean())
        return means

    def _set_reference(self, request: ReferenceRequest) -> None:
        now = self._clock.now()
        latest_s = -np.inf if self.latest is None else self.latest.trace.first_byte.monotonic_s
        degc = self._mean.mean() if now.monotonic_s - latest_s <= self._mean.window_s else np.empty(0)
        usable = int(np.isfinite(degc).sum())
        if usable == 0:
            window = f"the last {self._mean.window_s:.0f} s"
            why = f"reference of {request.source} refused: no temperature has arrived in {window}"
            self._deliver(ReferenceRefused(reference_id=request.reference_id, why=why))
            return
        reference = Reference(
            reference_id=request.reference_id,
            time=now,
            source=request.source,
            degc=degc,
            program=request.program,
            work_offset=request.work_offset,
            power_on_count=request.power_on_count,
        )
        self._reference, self._taken_up_s = reference, -np.inf
        self._since.begin(reference)
        if self._online is not None:
            self._online.refer(reference, now.monotonic_s)
        log.info("reference.set", source=request.source, sensors=usable, of=len(degc))
        self._deliver(reference)
        if self.latest is not None and (first := self._estimate(self.latest)) is not None:
            first = replace(first, trace=replace(first.trace, cleansed=None))
            self.latest_estimate = first
            self._deliver(first)
