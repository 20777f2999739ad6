"""The control task on a CNC in this process, moved on by a test turn by turn."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
from memory_cnc import MemoryNc

from config.records.commissioning import CommissionedAxis, CommissioningRecord, macro_map_digest
from config.schema import Configuration
from config.schema.cnc import CncConfig, MacroMapConfig, RequestMacrosConfig
from config.schema.cnc_drivers import OpcUaConfig
from config.schema.compensation import AxisConfig, CompensationConfig, OutputConfig, ReferenceConfig
from config.schema.service import HistoryConfig, ServiceConfig
from config.schema.temperatures import LineConfig, SensorConfig, TemperaturesConfig
from daemon.app import load_record
from daemon.cnc.audited_write import AuditedWriter
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.limits import CommissionedFactors, also_polled, output_limits
from daemon.cnc.macro_block import MacroBlock
from daemon.cnc.session import CncLink, CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.parts import ControlParts
from daemon.compensation.references import ToThermal
from daemon.compensation.restart import ResumePoint, load_resume_point
from daemon.compensation.snapshot import control_snapshot, output_actions
from daemon.compensation.task import ControlTask
from daemon.compensation.temperature_macro import TemperatureMacro
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.monitor.commands import CommandDesk
from daemon.monitor.status import StatusBoard
from daemon.snapshots import SnapshotBoard, ThermalSnapshot
from daemon.spindle_speed.messages import Planner
from daemon.spindle_speed.output import SpindleSpeedOutput
from daemon.state_store.documents import DaemonAlive
from daemon.state_store.store import StateStore
from daemon.supervisor import Backoff, run_with_reconnect
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.sim.nc.safe_point import GUARD_VERSION
from models.control.reference import request
from models.control.state import OperatorRequest
from models.records import CncSample, Instant, Reference, ThermalErrorEstimate, Trace

SENSOR_IDS = (1, 2, 3, 11, 12)
LINES = {"spindle": ["1-3"], "column": ["11-12"]}
SEQUENCE_A, X, Y, Z, VALID_UNTIL, ENABLE, SEQUENCE_B = 500, 501, 502, 503, 120, 504, 505
CHECK = 506
BLOCK = (SEQUENCE_A, X, Y, Z, VALID_UNTIL, ENABLE, CHECK, SEQUENCE_B)
EPOCH_S = 1_760_000_400.0
TURN_S = 0.5
FOREVER_S = 30.0
NO_TEMPERATURES = ThermalSnapshot(
    temperatures=None, estimate=None, line_faults={}, cycles_received=0, cycles_incomplete=0, estimates=0
)


class HandClock:
    """A clock that a test moves."""

    def __init__(self, monotonic_s: float = 1000.0, *, speed: float = 1.0) -> None:
        self.monotonic_s = monotonic_s
        self.speed = speed
        self.calendar_s = EPOCH_S

    def now(self) -> Instant:
        return Instant(
            monotonic_s=self.monotonic_s, utc_s=self.calendar_s + self.monotonic_s, real_s=self.monotonic_s / self.speed
        )

    async def sleep(self, duration_s: float) -> None:
        self.monotonic_s += duration_s


def machine(directory: Path, **changes: Any) -> Configuration:
    """Two lines with five sensors; y and z have models, x has none. `changes` go to the output's section."""
    cnc = changes.pop("cnc", {})
    return Configuration(
        machine="rig",
        temperatures=TemperaturesConfig(
            lines=[
                LineConfig(name=name, port=str(directory / f"{name}.tty"), chain=chain) for name, chain in LINES.items()
            ],
            sensors=[
                SensorConfig(id=i, device="TMP102", component="head" if i < 10 else "column", label="A")
                for i in SENSOR_IDS
            ],
        ),
        cnc=CncConfig(
            opcua=OpcUaConfig(endpoint="opc.tcp://127.0.0.1:1/none", namespace_uri="urn:toolpoint:cnc"),
            allow_insecure_writes=cnc.get("allow_insecure_writes", True),
            macros=MacroMapConfig(
                writable=["120", "500-506", "524"],
                sequence_a=SEQUENCE_A,
                values={"x": X, "y": Y, "z": Z},
                valid_until=VALID_UNTIL,
                enable=ENABLE,
                sequence_b=SEQUENCE_B,
                check=CHECK,
                echo_applied={"x": 511, "y": 512, "z": 513},
                echo_time=514,
                echo_status=515,
                echo_guard_version=516,
                request=RequestMacrosConfig(counter=520, kind=521, axis=522, value_mm=523, acknowledge=524),
            ),
        ),
        compensation=CompensationConfig(
            axes={
                name: AxisConfig(estimate=channel, absolute_bound_um=30.0, slew_um_per_min=60.0, step_um=10.0)
                for name, channel in (("x", None), ("y", "Y1"), ("z", "Z1"))
            },
            reference=ReferenceConfig(sequence_numbers=[100], positioning_dwell_s=2.0),
            output=OutputConfig(**({"safe_sequence_numbers": [900], "hold_limit_s": 600.0} | changes)),
        ),
        history=HistoryConfig(path=directory / "history.sqlite"),
        service=ServiceConfig(socket=directory / "s", http_port=None, retry_min_s=0.001, retry_max_s=0.002),
    )


def record_for(configuration: Configuration, **changes: Any) -> CommissioningRecord:
    """A commissioning of y and z on the simulated control."""
    content = {
        "cnc_identity": SIMULATED_CNC_IDENTITY,
        "macro_map_sha256": macro_map_digest(configuration.cnc.macros),
        "guard_version": GUARD_VERSION,
        "person": "a test",
        "date": "2026-01-01",
        "axes": {
            axis: CommissionedAxis(sign=1, scale=1.0, written_um=10.0, measured_um=10.0) for axis in ("x", "y", "z")
        },
    }
    return CommissioningRecord(**(content | changes))


class Rig:
    """One run of the control task; `turn` does what its loop does when poll and tick fall due."""

    def __init__(
        self,
        configuration: Configuration,
        nc: MemoryNc,
        clock: Clock,
        *,
        record: CommissioningRecord | None,
        model_problem: str = "",
        resume: ResumePoint | None = None,
        model_id: str = "made-up",
        planner: Planner | None = None,
    ) -> None:
        self.configuration, self.nc, self.clock = configuration, nc, clock
        self.telemetry = Telemetry()
        self.history = HistoryWriter(
            configuration.history.path, clock=clock, machine=MachineLayout.from_configuration(configuration)
        )
        self.asked: list[ToThermal] = []
        self.ticks = 0
        axes = tuple(configuration.compensation.axes)
        self.block = MacroBlock(
            configuration.cnc.macros,
            axes,
            CommissionedFactors(record, axes),
            guard=configuration.cnc.guard,
            also_polled=also_polled(configuration),
            pivots_mm=configuration.compensation.pivots_mm,
        )
        self.last_block = WriteAheadRecord.beside(configuration.history.path)
        loaded = load_resume_point(configuration, self.history, clock, self.last_block)
        self.resume = resume if resume is not None else loaded
        self.link = CncLink(nc.open, self._open_session)
        journal = Journal(self.history, StateStore(self.history, clock), self.resume.faults)
        self.interlocks = Interlocks(configuration, clock, record, lambda: model_problem, load_record(configuration)[1])
        self.speed = SpindleSpeedOutput(configuration, clock, journal, self.interlocks, planner, self.asked.append)
        self.temperature = TemperatureMacro(configuration, self.telemetry, journal, self.interlocks)
        self.control = ControlTask(
            ControlParts(
                configuration=configuration,
                clock=clock,
                link=self.link,
                history=self.history,
                telemetry=self.telemetry,
                journal=journal,
                interlocks=self.interlocks,
                limits=output_limits(configuration, CommissionedFactors(record, axes)),
                resume=self.resume,
                um_per_unit=self.block.um_per_unit,
                model_id=model_id,
                tell_thermal=self.asked.append,
                on_tick=lambda: self.on_tick(),  # noqa: PLW0108 - tests put another in its place
                on_sample=lambda sample: self.on_sample(sample),  # noqa: PLW0108 - tests put another in its place
                on_change=self._publish,
                macro_clients=(self.temperature, self.speed),
            )
        )
        self.snapshots = SnapshotBoard(control=control_snapshot(self.control), thermal=NO_TEMPERATURES)
        self._publish()

    def _publish(self) -> None:
        self.snapshots.control = control_snapshot(self.control)
        self.snapshots.spindle_speed = self.speed.snapshot()

    def desk(self) -> CommandDesk:
        """The commands of a person, without the picture of the status."""
        status = StatusBoard(self.configuration, self.clock, self.snapshots, self.telemetry.picture)
        axes = self.configuration.compensation.axes
        return CommandDesk(status, self.snapshots, output_actions(self.control, self._switch), axes)

    def alive(self) -> None:
        """Tell the store that the daemon lives, as its tick does."""
        StateStore(self.history, self.clock).put(DaemonAlive(utc_s=self.clock.now().utc_s))
        self.last_block.follow(self.history, begun=self.control.memory is not None)

    def _switch(self, on: bool, person: str) -> str:
        refusal = self.speed.turn(on=on, person=person)
        self._publish()
        return refusal

    def on_tick(self) -> None:
        """What the composition root does at every tick."""
        self.ticks += 1

    def on_sample(self, _sample: CncSample) -> None:
        """What the composition root does with every poll; of a rig without a thermal task nothing."""

    def _open_session(self, cnc: Any, last: CncSession | None) -> CncSession:
        known = last.known if last is not None else self.resume.known_macros
        writer = AuditedWriter(cnc, self.block, self.clock, self.history, self.telemetry)
        resumed = last is None or last.sample is None
        return CncSession(writer, self.control.limits, known, self.last_block, resumed=resumed)

    async def connected(self, *, timeout_s: float = FOREVER_S) -> None:
        """Return when the supervisor has opened a session."""
        async with asyncio.timeout(timeout_s):
            while self.link.session is None:
                await asyncio.sleep(0.001)

    async def turn(
        self, estimate: ThermalErrorEstimate | None = None, *, after_s: float = TURN_S, safe: bool = True
    ) -> None:
        """Let time pass, poll, decide and write; then let the guard run when the tool is away from the work."""
        self.clock.monotonic_s += after_s  # type: ignore[attr-defined]
        if estimate is not None:
            self.control.deliver(estimate)
        await self.hear()
        fresh, self.control._fresh = self.control._fresh, None
        await self.control._guarded(self.control._poll())
        await self.control._guarded(self.control._act(fresh))
        if safe:
            self.nc.safe_point()

    async def hear(self) -> None:
        """Let the control task take what waits for it."""
        await self.control._guarded(self.control._take_messages())

    async def serve(self) -> None:
        """Let the macros beside the block be written."""
        await self.hear()
        await self.control._guarded(self.control._serve_clients())

    def estimate(self, y_um: float, z_um: float, **changes: Any) -> ThermalErrorEstimate:
        """An estimate from now, relative to the present reference."""
        now = self.clock.now()
        reference = self.control.reference
        content = {
            "channels": ("Y1", "Z1"),
            "thermal_error_um": np.array([y_um, z_um]),
            "band_um": np.full(2, np.nan),
            "label_degc": {"A": 20.0},
            "label_increment_degc": {"A": 0.0},
            "in_domain": True,
            "confidence": 1.0,
            "imputed": (),
            "model_id": "made-up",
            "reference_id": reference.reference_id if reference is not None else None,
            "line": "spindle",
            "trace": Trace(first_byte=now, last_byte=now, cleansed=now, estimated=now),
        }
        return ThermalErrorEstimate(**(content | changes))

    def set_reference(self, reference_id: str = "r1", *, positioning: bool = True, handshake: bool = False) -> None:
        """Answer as the thermal task does, to a question of the control task or to one made up here."""
        nc = self.nc
        references = self.control._references
        if reference_id not in {asked.reference_id for asked in references.memory.requests}:
            step = request(references.memory, reference_id, "a test", positioning=positioning, handshake=handshake)
            references.memory, _ = step
        self.control.deliver(
            Reference(
                reference_id=reference_id,
                time=self.clock.now(),
                source="O1000 N100",
                degc=np.full(len(SENSOR_IDS), 20.0),
                program=nc.program,
                work_offset=nc.work_offset,
                power_on_count=nc.power_on_count,
            )
        )

    async def follow(self, y_um: float, z_um: float, turns: int = 40, **changes: Any) -> None:
        """Deliver the same error again and again."""
        for _ in range(turns):
            await self.turn(self.estimate(y_um, z_um, **changes))

    async def switch_on(self, *axes: str) -> None:
        """Have axes switched on by a person."""
        refusal = self.control.request(OperatorRequest(enable=frozenset(axes or ("y", "z"))), "a person")
        assert refusal == ""
        await self.turn()

    async def active(self, *, handshake: bool = False) -> None:
        """Go to ACTIVE with a reference and no error."""
        await self.turn()
        self.set_reference(handshake=handshake)
        await self.switch_on()
        await self.follow(0.0, 0.0, 2)
        assert self.state == "ACTIVE", self.control.memory

    @property
    def state(self) -> str:
        return self.control.memory.state.value if self.control.memory is not None else "none"

    def acknowledge(self, person: str) -> str:
        """Acknowledge the newest FAULT."""
        return self.control.request(OperatorRequest(acknowledge=self.control.journal.number), person)

    @property
    def applied(self) -> dict[str, float]:
        return self.nc.guard.applied_um


class Bench:
    """A directory, a clock and a control that outlive one run of the daemon."""

    def __init__(self, directory: Path, **changes: Any) -> None:
        self.configuration = machine(directory, **changes)
        self.clock = HandClock()
        self.nc = MemoryNc(self.configuration, self.clock)

    def rig(self, **changes: Any) -> Rig:
        content = {"record": record_for(self.configuration)} | changes
        return Rig(self.configuration, self.nc, self.clock, **content)


@contextlib.asynccontextmanager
async def running(rig: Rig, *, connect: bool = True) -> AsyncIterator[Rig]:
    """Keep the rig's link and history alive."""
    rig.history.start()
    keeper = asyncio.create_task(run_with_reconnect(rig.link.health, rig.link.attempt, Backoff(0.001, 0.002)))
    try:
        if connect:
            await rig.connected()
        yield rig
    finally:
        keeper.cancel()
        await asyncio.gather(keeper, return_exceptions=True)
        await asyncio.to_thread(rig.history.close)
        rig.last_block.follow(rig.history, begun=rig.control.memory is not None)
        rig.last_block.close()
