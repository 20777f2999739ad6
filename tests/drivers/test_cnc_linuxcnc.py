"""The LinuxCNC driver at LinuxCNC itself: the contract of every driver, and what it shows."""

import asyncio
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from cnc_contract import CHECKS, Check, connected
from real_linuxcnc import RealLinuxcnc, folder, missing
from scripted_machine import cnc_config

from drivers.clock import SystemClock
from drivers.contract import Cnc, FatalDriverError, LinkError, NotSentError
from drivers.linuxcnc.cnc import LinuxcncCnc
from drivers.linuxcnc_pins import VACANT, Pins
from models.records import CncMode, CncRun

REASON = missing()
pytestmark = [
    pytest.mark.wires,
    pytest.mark.skipif(bool(REASON), reason=REASON),
    pytest.mark.asyncio(loop_scope="module"),
]
CLOCK = "loadrt integ names=since-start\nsetp since-start.in 1\naddf since-start servo-thread\n"


def section(**changes: Any) -> Any:
    return cnc_config(linuxcnc=changes.pop("linuxcnc", {}), **changes)


PINS = Pins.of(section())
START = f"{CLOCK}net since-start since-start.out => motion.analog-in-{PINS.clock:02d}\n" + "".join(
    f"setp motion.analog-in-{index:02d} {VACANT}\n" for index in PINS.inputs.values()
)


class LinuxcncBench:
    """LinuxCNC, started once for all checks, and again after it was lost."""

    @property
    def z_mm(self) -> float:
        """Where LinuxCNC's own pins say that Z stands."""
        return float(self.linuxcnc.halcmd("getp", "joint.2.pos-fb"))

    def __init__(self, directory: Path) -> None:
        self.linuxcnc = RealLinuxcnc(directory, START)
        self.stands = False
        self.refused: list[int] = []

    async def reset(self) -> None:
        if not self.stands:
            await self.linuxcnc.start()
            self.stands = True
        for number in self.refused:
            self.linuxcnc.halcmd("unlinkp", f"motion.analog-in-{PINS.inputs[number]:02d}")
        self.refused.clear()
        for index in PINS.inputs.values():
            self.linuxcnc.halcmd("setp", f"motion.analog-in-{index:02d}", str(VACANT))

    def open(self, **changes: Any) -> Cnc:
        return LinuxcncCnc(section(linuxcnc={"command": self.linuxcnc.python()}, **changes), SystemClock())

    async def lose(self) -> None:
        self.stands = False
        await self.linuxcnc.stop()

    def refuse(self, number: int) -> None:
        self.refused.append(number)
        self.linuxcnc.halcmd("net", f"taken-{number}", f"motion.analog-in-{PINS.inputs[number]:02d}")


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def started() -> AsyncIterator[LinuxcncBench]:
    with folder() as directory:
        bench = LinuxcncBench(directory)
        yield bench
        await bench.linuxcnc.stop()


@pytest_asyncio.fixture(loop_scope="module")
async def bench(started: LinuxcncBench) -> LinuxcncBench:
    await started.reset()
    return started


async def test_what_linuxcnc_shows_is_what_a_poll_gives(bench: LinuxcncBench) -> None:
    cnc = await connected(bench)
    stopped = await cnc.read([510, 515])
    assert stopped.alarm and stopped.run is CncRun.RESET and stopped.macros == {510: None, 515: None}
    await bench.linuxcnc.switch_on()
    await bench.linuxcnc.mdi(f"M68 E{PINS.outputs[515]} Q2", f"M68 E{PINS.outputs[510]} Q0.004", "G55")
    sample = await cnc.read([510, 515])
    assert sample.macros == {510: 0.004, 515: 2.0}, "the guard has run"
    assert (sample.mode, sample.alarm, sample.work_offset) == (CncMode.MDI, False, 55)
    assert sample.clock_s > stopped.clock_s and sample.power_on_count == stopped.power_on_count
    assert math.isnan(sample.motor_temperature_degc) and cnc.identity == "linuxcnc:simulated mill"
    await cnc.write_macros([[(503, 1.25)]])
    await bench.linuxcnc.mdi(f"M66 E{PINS.inputs[503]} L0", "G54", "G0 Z#5399")
    assert await bench.linuxcnc.position_mm() == pytest.approx([0.0, 0.0, 1.25])
    with pytest.raises(NotSentError, match="#520 has no analog input"):
        await cnc.write_macros([[(500, 1.0)], [(520, 1.0)]])
    await cnc.close()


async def test_a_subroutine_in_a_file_of_its_own_is_no_other_program(bench: LinuxcncBench) -> None:
    part, subroutine = (bench.linuxcnc.directory / name for name in ("o1000.ngc", "wait.ngc"))
    part.write_text("G21 G90 G54\nG4 P0.1\no<wait> call\nG4 P0.1\nM2\n", encoding="ascii")
    subroutine.write_text("o<wait> sub\nG4 P0.3\nM66 E0 L0\nG4 P0.1\no<wait> endsub\nM2\n", encoding="ascii")
    cnc = await connected(bench)
    await bench.linuxcnc.switch_on()
    await bench.linuxcnc.do(["mode", "MODE_AUTO"], ["wait"], ["program_open", str(part)], ["wait"])
    assert (await cnc.read([])).program == 1000
    await bench.linuxcnc.do(["auto", "AUTO_RUN", 0])
    samples = []
    async with asyncio.timeout(20):
        while not samples or samples[-1].run is not CncRun.RESET:
            samples.append(await cnc.read([]))
            await asyncio.sleep(0.01)
    assert len(samples) > 3 and {(sample.program, sample.work_offset) for sample in samples} == {(1000, 54)}
    await cnc.close()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
async def test_it_does_what_the_daemon_relies_on(bench: LinuxcncBench, check: Check) -> None:
    await check(bench)


async def test_another_start_is_another_power_on_and_a_bridge_that_hangs_is_a_lost_link(bench: LinuxcncBench) -> None:
    cnc = await connected(bench)
    before = await cnc.read([500])
    await bench.lose()
    with pytest.raises(LinkError):
        await cnc.read([500])
    await cnc.close()
    await bench.reset()
    cnc = await connected(bench)
    after = await cnc.read([500])
    assert after.power_on_count != before.power_on_count and after.clock_s < before.clock_s + 60
    await cnc.close()
    command = ["/bin/sh", "-c", "sleep 30"]
    slow = LinuxcncCnc(section(linuxcnc={"command": command}, timeout_s=0.3), SystemClock())
    with pytest.raises(LinkError, match="did not answer within"):
        await slow.connect()
    none = LinuxcncCnc(section(linuxcnc={"command": ["/nowhere/python3"]}), SystemClock())
    with pytest.raises(FatalDriverError, match=r"cnc\.linuxcnc\.command: /nowhere/python3 cannot be started"):
        await none.connect()
