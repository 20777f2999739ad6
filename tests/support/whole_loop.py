"""Thermal task, control task and the guard's text on one clock: everything between the sensors and the tool."""

import asyncio
import contextlib
from pathlib import Path

import numpy as np
from control_rig import SENSOR_IDS, Bench, HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, VALUE
from thermal_rig import CHAINS

from config.records.commissioning import CommissionedAxis
from config.schema import Configuration
from daemon.estimation.inputs import Message, poll_of
from daemon.estimation.task import ThermalTask
from models.quality import Quality, Reason
from models.records import CncSample, FloatArray, TemperatureCycle, Trace
from models.thermal.family import ThermalModel
from models.thermal.features import Design, Layout
from models.thermal.linear import LinearModel
from models.thermal.model import Domain, TestVector
from models.thermal.solution import Solution
from models.thermal.training.making import FIRST_POSITION_ID

MOMENT_S = 10.0
SLEW_UM_PER_MIN = 12.0
REACH_UM = SLEW_UM_PER_MIN * MOMENT_S / 60.0
"""So far a value may go from one moment to the next."""
BOUND_UM = 30.0
STEP_UM = 10.0


def loop_machine(directory: Path, policy: str) -> Configuration:
    """The rig's machine with a slower slew rate and polls that may lie ten seconds apart."""
    whole = machine(directory)
    axes = {
        name: axis.model_copy(update={"slew_um_per_min": SLEW_UM_PER_MIN})
        for name, axis in whole.compensation.axes.items()
    }
    retreat = [50] if policy == "zero_first" else []
    changes = {"policy": policy, "positioning_dwell_s": 25.0, "retreat_sequence_numbers": retreat}
    reference = whole.compensation.reference.model_copy(update=changes)
    compensation = whole.compensation.model_copy(update={"axes": axes, "reference": reference})
    return whole.model_copy(update={"compensation": compensation})


def lagged_model(
    name: str, axis_positions: tuple[str, ...] = (), lags_min: tuple[float, ...] = (1.0, 2.0)
) -> LinearModel:
    """A model whose states are filled after four times its longest lag; of positions about 0.05 um/mm."""
    sensors, rng = len(SENSOR_IDS) + len(axis_positions), np.random.default_rng(5)
    layout = Layout(sensors=sensors, lags_min=lags_min, speed_lags_min=())
    directions = np.linalg.qr(rng.normal(size=(layout.columns, layout.columns)))[0]
    weights = rng.uniform(0.0, 0.6, (layout.columns, 2))
    highest, of_positions = np.full(sensors, 80.0), np.arange(sensors) >= len(SENSOR_IDS)
    highest[of_positions] = 500.0
    weights[np.tile(of_positions, 3)] *= 0.05
    features, reference = rng.normal(22.0, 2.0, layout.columns), np.full(layout.columns, 20.0)
    return LinearModel(
        model_id=name,
        kind="default",
        channels=("Y1", "Z1"),
        sensor_ids=(*SENSOR_IDS, *range(FIRST_POSITION_ID, FIRST_POSITION_ID + len(axis_positions))),
        sensor_names=(*(f"t{i}" for i in SENSOR_IDS), *axis_positions),
        axis_positions=axis_positions,
        layout=layout,
        speed_scale_rpm=1.0,
        period_min=1.0,
        solutions=(
            Solution(
                layout=layout,
                design=Design(departures=False),
                gain=np.ones(layout.columns),
                weights=weights,
                directions=directions,
                remaining=np.linspace(0.02, 1.0, layout.columns),
            ),
        ),
        drift_um_per_min=np.zeros(2),
        centre=np.full(layout.columns, 20.0),
        domain=Domain(
            of_increments=False,
            lowest=np.full(sensors, -20.0),
            highest=highest,
            leverage_limit=1e4 * 500.0 ** (2 * len(axis_positions)),
        ),
        band_um=np.full(2, np.nan),
        watch=None,
        hyper_parameters={},
        refused=None,
        training=(),
        created="2026-01-01T00:00:00Z",
        test_vectors=(
            TestVector(
                features=features,
                reference=reference,
                elapsed_min=0.0,
                thermal_error_um=(features - reference) @ weights,
            ),
        ),
    )


class WholeLoop(Bench):
    """A machine that outlives runs of the daemon, moved on moment by moment."""

    def __init__(
        self,
        directory: Path,
        model: ThermalModel,
        *,
        policy: str = "bumpless",
        configuration: Configuration | None = None,
        proved: dict[str, CommissionedAxis] | None = None,
    ) -> None:
        self.configuration = configuration or loop_machine(directory, policy)
        self.proved = {} if proved is None else {"axes": proved}
        self.clock = HandClock()
        self.nc = MemoryNc(self.configuration, self.clock)
        for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE):
            self.nc.macros.set(number, 0.0)
        self.nc.sequence_number = 900
        self.model = model
        self.degc: FloatArray = np.full(len(SENSOR_IDS), 20.0)
        self.rise_k: FloatArray = np.zeros(len(SENSOR_IDS))
        """Rise of each sensor's place from moment to moment [K]."""
        self.offset_k: FloatArray = np.zeros(len(SENSOR_IDS))
        """Error of each sensor [K]; NaN: it is silent."""
        self.rig: Rig
        self.thermal: ThermalTask
        self._open = contextlib.AsyncExitStack()
        self._numbers = dict.fromkeys(CHAINS, 0)

    async def start(self) -> None:
        """Start the daemon."""
        self.rig = self.new_rig()
        self._open = contextlib.AsyncExitStack()
        await self._open.enter_async_context(running(self.rig, connect=self.nc.reachable))
        inbox: asyncio.Queue[Message] = asyncio.Queue()
        self.thermal = ThermalTask(
            self.configuration,
            self.clock,
            self.rig.history,
            self.rig.telemetry,
            self.model,
            inbox,
            self.rig.control.deliver,
        )
        if self.configuration.cnc.axis_positions:
            self.rig.on_sample = self._polled  # type: ignore[method-assign]

    def _polled(self, sample: CncSample) -> None:
        self.rig.asked.append(poll_of(sample, self.rig.link.cnc))

    def new_rig(self) -> Rig:
        record = record_for(self.configuration, **self.proved)
        return Rig(self.configuration, self.nc, self.clock, record=record, model_id=self.model.model_id)

    async def end(self) -> None:
        """End the daemon without a word, as a crash does; what it has handed to the store is there."""
        self.rig.alive()
        await self._open.aclose()

    async def use_model(self, model: ThermalModel) -> None:
        """Take up another model."""
        self.model = model
        await self.rig.history.flushed()
        await self.thermal._take(model)

    async def moment(self) -> None:
        """Let both lines speak, poll, decide and write; the guard is not called."""
        self.clock.monotonic_s += MOMENT_S
        self.degc = self.degc + self.rise_k
        if self.nc.reachable:
            await self.rig.connected()
        first = 0
        for line, chain in CHAINS.items():
            await self._speak(line, slice(first, first + len(chain)))
            first += len(chain)
        control = self.rig.control
        await self.rig.hear()
        fresh, control._fresh = control._fresh, None
        await control._guarded(control._poll())
        await control._guarded(control._act(fresh))
        await self.hand_on()
        await asyncio.sleep(0)

    async def hand_on(self) -> None:
        """Hand what the control task has asked for to the thermal task."""
        asked, self.rig.asked[:] = list(self.rig.asked), []
        for message in asked:
            await self.thermal._take(message)

    async def _speak(self, line: str, part: slice) -> None:
        values = (self.degc + self.offset_k)[part]
        silent = np.isnan(values)
        self._numbers[line] += 1
        now = self.clock.now()
        await self.thermal._take(
            TemperatureCycle(
                line=line,
                number=self._numbers[line],
                degc=values,
                quality=np.where(silent, Quality.MISSING, Quality.GOOD).astype(np.uint8),
                reason=np.where(silent, Reason.NOT_RECEIVED, Reason.NONE).astype(np.uint8),
                complete=not silent.any(),
                trace=Trace(first_byte=now, last_byte=now),
            )
        )

    @property
    def written_um(self) -> FloatArray:
        """What the block holds [um]."""
        return np.nan_to_num(self.rig.block.values_um({n: self.nc.macros.get(n) for n in self.rig.block.ours}))

    @property
    def applied_um(self) -> FloatArray:
        """What the NC has really taken over: its external offset without the operator's [um]."""
        return np.array([self.nc.guard.applied_um[axis] for axis in self.configuration.compensation.axes])
