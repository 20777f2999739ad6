"""A day of the daemon at LinuxCNC itself: Modbus box, thermal model, daemon and guard, and where the axis stands.

LinuxCNC runs headless in namespaces of its own as an ordinary user, the daemon as a process of its own, in real time.
"""

import asyncio
import contextlib
import json
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pytest_asyncio
import yaml
from real_linuxcnc import RealLinuxcnc, folder, missing
from wires import client_of

from config.loader import load_configuration
from config.records.commissioning import CommissionedAxis, CommissioningRecord, macro_map_digest
from config.records.commissioning_file import save_commissioning
from drivers.guard.linuxcnc import linuxcnc_text, memory_of
from drivers.guard.text import GUARD_VERSION, GuardStatus
from drivers.linuxcnc_pins import Pins
from drivers.sim.wires.modbus_box import ModbusTcpBox, at_once
from models.thermal.training.making import increment_model

REASON = missing()
pytestmark = [
    pytest.mark.wires,
    pytest.mark.slow,
    pytest.mark.skipif(bool(REASON), reason=REASON),
    pytest.mark.asyncio(loop_scope="module"),
]
WORK_MM = 10.0
UM_PER_K = 2.0
STEP_UM = 3.0
Z, UNTIL = 503, 120
PATIENCE_S = 60.0
"""What never happens is given up after this long [s]."""
SENSORS = [{"id": 1, "address": 0, "component": "Spindle unit", "scale": 0.1}]


def content(directory: Path, port: int) -> dict[str, Any]:
    """The configuration of a mill with one axis, in which everything goes quickly."""
    return {
        "machine": "simulated mill",
        "temperatures": {
            "sources": [
                {
                    "name": "box",
                    "driver": "modbus",
                    "cycle_period_s": 0.25,
                    "modbus": {"host": "127.0.0.1", "port": port, "sensors": SENSORS},
                }
            ],
            "cleansing": {"max_change_degc": 10.0, "max_rate_degc_per_min": 600.0, "noise_degc": 5.0},
        },
        "cnc": {
            "driver": "linuxcnc",
            "linuxcnc": {"command": ["/bin/sh", str(directory / "inside")]},
            "poll_period_s": 0.1,
            "timeout_s": 3.0,
            "macros": {
                "writable": [UNTIL, "500-506", 524],
                "sequence_a": 500,
                "values": {"z": Z},
                "valid_until": UNTIL,
                "enable": 504,
                "sequence_b": 505,
                "check": 506,
                "echo_applied": {"z": 512},
                "echo_time": 513,
                "echo_status": 514,
                "echo_guard_version": 515,
                "safe_flag": 517,
                "request": {"counter": 520, "kind": 521, "axis": 522, "value_mm": 523, "acknowledge": 524},
            },
            "guard": {
                "dialect": "linuxcnc",
                "increment_mm": 0.0001,
                "on_expiry": "zero",
                "axes": {"z": {"letter": "Z", "number": 3}},
            },
        },
        "compensation": {
            "model_file": str(directory / "model.json"),
            "allow_writable_model_directory": True,
            "commissioning_file": str(directory / "commissioning.json"),
            "axes": {
                "z": {"estimate": "Z1", "absolute_bound_um": 50.0, "slew_um_per_min": 100.0, "step_um": STEP_UM},
            },
            "reference": {"mean_s": 1.0},
            "output": {
                "tick_s": 0.25,
                "validity_s": 3.0,
                "stale_after_s": 2.0,
                "alarm_after_s": 4.0,
                "hold_limit_s": 5.0,
            },
        },
        "history": {"path": str(directory / "history.sqlite")},
        "service": {
            "socket": str(directory / "control.sock"),
            "http_port": None,
            "retry_min_s": 0.1,
            "retry_max_s": 0.5,
        },
    }


class Session:
    """LinuxCNC with the guard's text, a box of one PT100, the daemon, and a person who goes from one to the other."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.tenths = 200
        self.box = ModbusTcpBox(lambda _unit, _table, _start, count: [self.tenths] * count)
        self.path = directory / "toolpoint.yaml"
        self.daemon: subprocess.Popen[bytes] | None = None
        self.client: Any = None

    async def prepare(self) -> None:
        """Write everything that a commissioned machine has, and start LinuxCNC."""
        await self.box.start()
        self.path.write_text(yaml.safe_dump(content(self.directory, self.box.port)), encoding="utf-8")
        self.configuration = load_configuration(self.path)
        self.pins = Pins.of(self.configuration.cnc)
        model = increment_model(
            model_id="pt100",
            kind="increments",
            channels=("Z1",),
            sensor_ids=(1,),
            sensor_names=("t1",),
            coefficients_um_per_k=np.array([[UM_PER_K]]),
            drift_um_per_min=np.zeros(1),
            lowest_increment_k=np.full(1, -20.0),
            highest_increment_k=np.full(1, 20.0),
            band_um=np.full(1, np.nan),
            training=(),
            created="2026-01-01T00:00:00Z",
            test_pairs=[(np.full(1, 21.0), np.full(1, 20.0))],
        )
        (self.directory / "model.json").write_text(model.to_json(), encoding="utf-8")
        proof = CommissionedAxis(sign=1, scale=1.0, written_um=5.0, measured_um=5.0)
        record = CommissioningRecord(
            cnc_identity="linuxcnc:simulated mill",
            macro_map_sha256=macro_map_digest(self.configuration.cnc.macros),
            guard_version=GUARD_VERSION,
            person="a test",
            date="2026-01-01",
            axes={"z": proof},
        )
        save_commissioning(record, self.directory / "commissioning.json")
        cnc, axes = self.configuration.cnc, self.configuration.compensation.axes
        (self.directory / "toolpoint.ngc").write_text(linuxcnc_text(cnc, axes, machine="mill"), encoding="ascii")
        memory = "".join(f"{number}\t0.000000\n" for number in memory_of(cnc.guard, axes))
        (self.directory / "mill.var").write_text(memory, encoding="ascii")
        clock = "loadrt integ names=since-start\nsetp since-start.in 1\naddf since-start servo-thread\n"
        clock += f"net since-start since-start.out => motion.analog-in-{self.pins.clock:02d}\n"
        self.linuxcnc = RealLinuxcnc(self.directory, clock)
        await self.start_linuxcnc()
        await self.linuxcnc.mdi("o<toolpoint> call [5]")

    async def start_linuxcnc(self) -> None:
        """Start it, let the daemon's bridge in, switch on, and go to the work."""
        await self.linuxcnc.start()
        python = " ".join(self.linuxcnc.python())
        (self.directory / "inside").write_text(f'exec {python} "$@"\n', encoding="ascii")
        await self.linuxcnc.switch_on()
        await self.linuxcnc.mdi("G21 G90 G40 G80 G54", f"G0 X0 Y0 Z{WORK_MM}")

    async def start_daemon(self) -> None:
        """Start it as a service does."""
        command = [sys.executable, "-P", "-m", "daemon.cli", "run", "--config", str(self.path)]
        with (self.directory / "daemon.log").open("ab") as log:
            self.daemon = subprocess.Popen(command, stdout=log, stderr=log)
        socket, log_file = self.configuration.service.socket, self.directory / "daemon.log"
        self.client = await asyncio.to_thread(client_of, self.daemon, socket, PATIENCE_S, log_file)

    def kill_daemon(self) -> None:
        if self.daemon is not None and self.daemon.poll() is None:
            self.daemon.kill()
            self.daemon.wait()
            self.client.close()

    async def end(self) -> None:
        self.kill_daemon()
        await self.linuxcnc.stop()
        await self.box.stop()

    async def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        answer = await asyncio.to_thread(self.client.ask, command, **arguments)
        assert isinstance(answer, dict)
        return answer

    async def wait(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the first status that meets the condition."""
        status: dict[str, Any] = {}
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                while not condition(status := await self.ask("status")):
                    await asyncio.sleep(0.05)
                return status
        shown = {key: status[key] for key in ("output", "axes", "reference", "reference_ended", "links")}
        raise AssertionError(json.dumps(shown, indent=1))

    async def state(self, name: str) -> dict[str, Any]:
        return await self.wait(lambda status: status["output"]["state"] == name)

    def warm(self, kelvin: float) -> None:
        self.tenths = round(200 + 10 * kelvin)

    async def applied(self, um: float) -> None:
        """Pass safe points until the daemon sees so much applied; one that meets a write moves nothing."""
        right = {GuardStatus.APPLIED, GuardStatus.DISABLED if um == 0.0 else GuardStatus.APPLIED}
        near_um = 0.05 if um == 0.0 else 0.11  # a retreat ends at zero, not an increment beside it
        async with asyncio.timeout(PATIENCE_S):
            while (await self.ask("status"))["axes"]["z"]["applied_um"] != pytest.approx(um, abs=near_um):
                before = await self.moved_um()
                if (passed := await self.guard(1)) is GuardStatus.TORN:
                    assert await self.moved_um() == pytest.approx(before, abs=1e-3)
                else:
                    assert passed in right  # a retreat that has come to zero switches off
        assert await self.moved_um() == pytest.approx(um, abs=near_um)

    def macro(self, number: int) -> float:
        """Return what LinuxCNC's pins hold, seen from its own side."""
        kind, place = ("in", self.pins.inputs) if number in self.pins.inputs else ("out", self.pins.outputs)
        return float(self.linuxcnc.halcmd("-s", "getp", f"motion.analog-{kind}-{place[number]:02d}"))

    def kept_um(self) -> float:
        """Return G54's Z in the file of LinuxCNC's parameters [um]."""
        rows = (line.split() for line in (self.directory / "mill.var").read_text().splitlines())
        return next(float(row[1]) * 1000.0 for row in rows if row[0] == "5223")

    async def guard(self, times: int = 2) -> GuardStatus:
        """Pass safe points, and position again."""
        for _ in range(times):
            await self.linuxcnc.mdi("o<toolpoint> call [1]")
        await self.linuxcnc.mdi(f"G0 Z{WORK_MM}")
        return GuardStatus(round(self.macro(514)))

    async def moved_um(self) -> float:
        """Return how far from the programmed place LinuxCNC says that Z stands."""
        return ((await self.linuxcnc.position_mm())[2] - WORK_MM) * 1000.0


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def session() -> AsyncIterator[Session]:
    with folder() as directory:
        session = Session(directory)
        await session.prepare()
        try:
            await session.start_daemon()
            yield session
        finally:
            await session.end()


async def test_work_is_positioned_by_the_programs_request_and_compensated(session: Session) -> None:
    await session.wait(lambda status: status["output"]["since_s"] is not None and status["cycles"]["received"] >= 6)
    await session.ask("enable")
    await session.linuxcnc.mdi("o<toolpoint> call [2] [1]")
    status = await session.state("ACTIVE")
    assert status["reference"]["source"].startswith("request") and status["reference"]["work_offset"] == 54
    session.warm(2.0)
    await session.applied(-2.0 * UM_PER_K)
    assert session.macro(Z) == pytest.approx(-2.0 * UM_PER_K / 1000.0, abs=1.1e-4)
    assert await session.moved_um() == pytest.approx(1000.0 * session.macro(Z), abs=0.05), "as far as was written"


async def test_without_temperatures_it_holds_and_then_retreats(session: Session) -> None:
    before = await session.moved_um()
    session.box.way = lambda answer, send: None  # the box has died
    await session.state("HOLD")
    assert await session.guard() is GuardStatus.APPLIED
    assert await session.moved_um() == pytest.approx(before, abs=1e-4), "it moved while the output holds"
    await session.state("RETREAT")
    await session.applied(0.0)
    await session.state("OFF")
    session.box.way = at_once
    await session.wait(lambda status: status["links"][0]["up"])
    await session.ask("enable")
    await session.state("ACTIVE")
    await session.applied(before)


async def test_an_emergency_stop_is_an_alarm_and_the_output_goes_on_after_it(session: Session) -> None:
    before = await session.moved_um()
    await session.linuxcnc.do(["state", "STATE_ESTOP"], ["wait"])
    await session.wait(lambda status: status["cnc"]["alarm"])
    await session.linuxcnc.switch_on()
    status = await session.wait(lambda status: not status["cnc"]["alarm"])
    assert status["output"]["state"] == "ACTIVE", status["output"]
    await session.applied(before)


async def test_a_daemon_that_died_lets_the_guard_step_to_zero_and_comes_back(session: Session) -> None:
    before = await session.moved_um()
    session.kill_daemon()
    until_s = session.macro(UNTIL)
    async with asyncio.timeout(PATIENCE_S):
        while float(session.linuxcnc.halcmd("-s", "getp", f"motion.analog-in-{session.pins.clock:02d}")) <= until_s:
            await asyncio.sleep(0.1)
    assert await session.guard(1) is GuardStatus.EXPIRED
    assert await session.moved_um() == pytest.approx(before + STEP_UM, abs=1e-3), "one step of policy zero"
    assert await session.guard(2) is GuardStatus.EXPIRED
    assert await session.moved_um() == pytest.approx(0.0, abs=1e-3)
    await session.start_daemon()
    await session.state("ACTIVE")
    await session.applied(before)


async def test_a_restart_of_linuxcnc_stops_everything_until_a_person_acknowledges(session: Session) -> None:
    before = await session.moved_um()
    await session.linuxcnc.do(["state", "STATE_ESTOP"], ["wait"])
    async with asyncio.timeout(PATIENCE_S):
        while session.kept_um() != pytest.approx(before, abs=1e-3):  # LinuxCNC writes its parameters
            await asyncio.sleep(0.05)
    await session.linuxcnc.stop()
    await session.wait(lambda status: not link(status)["up"])
    await session.start_linuxcnc()
    assert await session.moved_um() == pytest.approx(before, abs=1e-3), "it keeps what is applied"
    status = await session.state("FAULT")
    assert "#500 holds 0, we wrote" in status["output"]["reason"] and session.macro(Z) == 0.0
    assert status["reference"] is None and "switched off and on" in status["reference_ended"]
    assert await session.guard() is GuardStatus.DISABLED
    assert await session.moved_um() == pytest.approx(before, abs=1e-3)
    newest = (await session.state("FAULT"))["output"][
        "fault"
    ]  # another number when more of the block was seen to differ
    await session.ask("acknowledge", fault=newest)
    await session.wait(lambda status: status["output"]["state"] != "FAULT")
    await session.ask("enable")  # where LinuxCNC took so long to start that it was held for too long
    await session.linuxcnc.mdi("o<toolpoint> call [2] [1]")
    await session.state("ACTIVE")
    session.warm(3.0)
    await session.applied(before - UM_PER_K)


def link(status: dict[str, Any]) -> dict[str, Any]:
    return next(link for link in status["links"] if link["name"] == "cnc")
