"""The guard's text for LinuxCNC, run by LinuxCNC itself: what is written by the driver is where the axis stands."""

import asyncio
import contextlib
import subprocess
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from real_linuxcnc import RealLinuxcnc, folder, missing
from scripted_machine import cnc_config

from config.schema.cnc import CncConfig, MacroMapConfig
from config.schema.compensation import CompensationConfig
from drivers.clock import SystemClock
from drivers.contract import Capability, NotSentError
from drivers.guard.check import block_check
from drivers.guard.linuxcnc import linuxcnc_text, memory_of
from drivers.guard.text import GuardStatus
from drivers.linuxcnc.cnc import LinuxcncCnc
from drivers.linuxcnc_pins import Pins

REASON = missing()
pytestmark = [
    pytest.mark.wires,
    pytest.mark.skipif(bool(REASON), reason=REASON),
    pytest.mark.asyncio(loop_scope="module"),
]
GUARD = {"dialect": "linuxcnc", "increment_mm": 0.0001}
PIVOT_MM, FARTHEST_MM = 10.0, 110.0
LIMITS = {"slew_um_per_min": 2.0, "absolute_bound_um": 50.0, "step_um": 2.0}
SLOPE = {"of": "Z", "pivot_mm": PIVOT_MM, "travel_mm": (0.0, FARTHEST_MM)}
AXES = CompensationConfig.model_validate(
    {
        "axes": {
            "X": LIMITS,
            "Y": LIMITS,
            "Z": {"slew_um_per_min": 3.0, "absolute_bound_um": 60.0, "step_um": 3.0},
            "S": {"slew_um_per_min": 10.0, "absolute_bound_um": 100.0, "step_um": 10.0, "slope": SLOPE},
        }
    }
).outputs
"""What the slope S leaves Z is what X and Y have."""


def config(guard: Mapping[str, Any] = GUARD, request: Mapping[str, int] | None = None, **section: Any) -> CncConfig:
    """The map of the other tests, variables of a slope, and of requests."""
    plain = cnc_config(linuxcnc=section, guard=guard)
    slope = {"values": plain.macros.values | {"S": 507}, "echo_applied": plain.macros.echo_applied | {"S": 516}}
    macros = MacroMapConfig.model_validate(plain.macros.model_dump() | slope | {"request": request})
    return plain.model_copy(update={"macros": macros})


CONFIG = config()
CLOCK = "loadrt integ names=since-start\nsetp since-start.in 1\naddf since-start servo-thread\n"
CLOCK += f"net since-start since-start.out => motion.analog-in-{Pins.of(CONFIG).clock:02d}\n"
WORK_MM = 10.0


class Mill:
    """LinuxCNC with the guard's text, the driver, and a person who positions and calls the guard."""

    def __init__(self, directory: Path, units: str = "mm") -> None:
        self.linuxcnc = RealLinuxcnc(directory, CLOCK, units)
        self.cnc = LinuxcncCnc(CONFIG, SystemClock())
        self.sequence = 0.0

    async def start(self) -> None:
        """Start it, connect, switch on, and position the work."""
        await self.linuxcnc.start()
        self.cnc = LinuxcncCnc(config(command=self.linuxcnc.python()), SystemClock())
        await self.cnc.connect()
        await self.linuxcnc.switch_on()
        await self.linuxcnc.mdi("G21 G90 G40 G80 G54", f"G0 X0 Y0 Z{WORK_MM}")

    async def stop(self) -> None:
        """End LinuxCNC as it is ended, so that it keeps its parameters."""
        await self.cnc.close()
        await self.linuxcnc.stop()

    async def write(
        self, um: Mapping[str, float], *, enable: float = 7.0, valid_s: float = 60.0, wrong: float = 0
    ) -> None:
        """Write a block as the daemon does."""
        self.sequence += 1.0
        while (until_s := round((await self.cnc.read([])).clock_s + valid_s, 1)) <= 0.0:  # its clock has just begun
            await asyncio.sleep(0.1)
        macros = CONFIG.macros
        held: dict[int, float | None] = {macros.values[axis]: um.get(axis, 0.0) / 1000.0 for axis in AXES}
        held |= {macros.valid_until: until_s, macros.enable: enable, macros.sequence_b: self.sequence}
        check = block_check(macros, AXES, held, {"S": PIVOT_MM}) + wrong
        block = [(number, float(held[number] or 0.0)) for number in held if number != macros.sequence_b]
        assert macros.check is not None
        await self.cnc.write_macros(
            [[(500, self.sequence)], [*block, (macros.check, check)], [(macros.sequence_b, self.sequence)]]
        )
        await self.linuxcnc.take(Pins.of(CONFIG).inputs[macros.sequence_b], self.sequence)

    async def guard(self) -> GuardStatus:
        """Call it, let a stop for the operator go on, and return its status once its echo has another time."""
        before = (await self.cnc.read_macros([513]))[513]
        await self.linuxcnc.mdi("o<toolpoint> call [1]")
        async with asyncio.timeout(30):
            while (echo := await self.cnc.read_macros([513, 514]))[513] in (None, before):
                await self.linuxcnc.do(["pass"])  # a busy computer may stop it after the call looked done
        assert echo[514] is not None
        return GuardStatus(int(echo[514]))

    async def stands_mm(self, at_mm: float = WORK_MM) -> float:
        """Position again, and return where LinuxCNC says that Z is."""
        await self.linuxcnc.mdi(f"G0 Z{at_mm}")
        return (await self.linuxcnc.position_mm())[2]

    async def applied_um(self, echo: int = 512) -> float | None:
        applied = (await self.cnc.read_macros([echo]))[echo]
        return None if applied is None else applied * 1000.0


@contextlib.asynccontextmanager
async def started(units: str = "mm", request: Mapping[str, int] | None = None, **guard: Any) -> AsyncIterator[Mill]:
    with folder() as directory:
        text = linuxcnc_text(config(GUARD | guard, request), AXES, machine="mill")
        (directory / "toolpoint.ngc").write_text(text, encoding="ascii")
        memory = "".join(f"{number}\t0.000000\n" for number in memory_of(CONFIG.guard, AXES))
        (directory / "mill.var").write_text(memory, encoding="ascii")
        mill = Mill(directory, units)
        try:
            await mill.start()
            yield mill
        finally:
            await mill.stop()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def mill() -> AsyncIterator[Mill]:
    async with started() as mill:
        yield mill


async def test_a_day_at_the_machine(mill: Mill) -> None:
    assert await mill.applied_um() is None, "the guard has not run since the start"
    await mill.linuxcnc.mdi("o<toolpoint> call [5]")
    assert await mill.stands_mm() == pytest.approx(WORK_MM)

    await mill.write({"Z": 3.0})
    assert await mill.guard() is GuardStatus.APPLIED
    assert await mill.stands_mm() == pytest.approx(WORK_MM + 0.002, abs=1e-7), "one step"
    assert await mill.guard() is GuardStatus.APPLIED
    assert await mill.stands_mm() == pytest.approx(WORK_MM + 0.003, abs=1e-7)
    assert await mill.applied_um() == pytest.approx(3.0)
    await mill.write({"X": 1.0, "Y": -2.0, "Z": 3.0})
    assert await mill.guard() is GuardStatus.APPLIED
    await mill.linuxcnc.mdi("G0 X0 Y0")
    assert await mill.linuxcnc.position_mm() == pytest.approx([0.001, -0.002, WORK_MM + 0.003], abs=1e-7)


@pytest.mark.parametrize(
    ("block", "status"),
    [
        ({"um": {"Z": 1.0}, "wrong": 1.0}, GuardStatus.CHECK),
        ({"um": {"Z": 51.0}}, GuardStatus.OVERSIZE),
        ({"um": {"Z": 1.0}, "enable": 16.0}, GuardStatus.OVERSIZE),
        ({"um": {"Z": 1.0}, "enable": 0.0}, GuardStatus.DISABLED),
        ({"um": {"Z": 1.0}, "valid_s": 300.0}, GuardStatus.EXPIRED),
        ({"um": {"Z": 1.0}, "valid_s": -1.0}, GuardStatus.EXPIRED),
    ],
)
async def test_what_does_not_count_moves_nothing(mill: Mill, block: dict[str, float], status: GuardStatus) -> None:
    before = await mill.stands_mm()
    await mill.write(**block)  # type: ignore[arg-type]
    assert await mill.guard() is status
    assert await mill.stands_mm() == pytest.approx(before, abs=1e-9)


async def test_a_slope_counts_for_where_the_axis_stands_and_is_out_again_wherever_that_is(mill: Mill) -> None:
    await mill.write({"X": 1.0, "Y": -2.0, "Z": 3.0, "S": 20.0}, enable=15.0)
    plain_mm = await mill.stands_mm()
    for applied_um in (9.0, 18.0, 20.0):
        assert await mill.guard() is GuardStatus.APPLIED
        assert await mill.applied_um(516) == pytest.approx(applied_um)
    assert await mill.stands_mm() == pytest.approx(plain_mm, abs=1e-7), "it stands at the pivot"
    far_mm = FARTHEST_MM - 0.1  # offsets of some um lie between there and the end
    await mill.stands_mm(far_mm)
    for moved_um, status in ((0.9, GuardStatus.NEARING), (1.8, GuardStatus.NEARING), (2.0, GuardStatus.APPLIED)):
        assert await mill.guard() is status
        await mill.linuxcnc.mdi("M68 E63 Q[#<_value>]")
        assert float(mill.linuxcnc.halcmd("getp", "motion.analog-out-63")) == status, "a program can wait for it"
        assert await mill.stands_mm(far_mm) - far_mm == pytest.approx(plain_mm - WORK_MM + moved_um / 1000.0, abs=1e-7)
    await mill.linuxcnc.mdi("G43.1 Z1")
    assert await mill.stands_mm(far_mm) > FARTHEST_MM
    assert await mill.guard() is GuardStatus.PLACE, "what counts is the machine position, with the tool's length"
    await mill.linuxcnc.mdi("G49")
    assert await mill.stands_mm() == pytest.approx(plain_mm + 0.002, abs=1e-7), "where it was called last decides"
    await mill.write({"X": 1.0, "Y": -2.0, "Z": 3.0}, enable=15.0)
    await mill.stands_mm(60.0)
    for _ in range(4):
        await mill.guard()
    assert await mill.applied_um(516) == 0.0
    assert await mill.stands_mm() == pytest.approx(plain_mm, abs=1e-7)


async def test_a_block_that_is_being_written_and_another_coordinate_system_move_nothing(mill: Mill) -> None:
    await mill.write({"Z": 1.0})
    before = await mill.stands_mm()
    await mill.linuxcnc.mdi("G55")
    assert await mill.guard() is GuardStatus.MODAL
    await mill.linuxcnc.mdi("G54")
    await mill.cnc.write_macros([[(500, 77.0)]])
    assert await mill.guard() is GuardStatus.TORN
    assert await mill.stands_mm() == pytest.approx(before, abs=1e-9)


async def test_a_call_that_this_text_does_not_know_says_so_and_not_that_it_applied(mill: Mill) -> None:
    """This machine has neither handshake nor flag: a request that nobody hears is no reference."""
    await mill.write({"Z": 1.0})
    before = await mill.cnc.read_macros([513, 514])
    for numbers in ("", "[2] [1] [0]", "[3]", "[4]", "[1.5]"):
        await mill.linuxcnc.mdi(f"o<toolpoint> call {numbers}")
        (*_, said) = await mill.linuxcnc.do(["messages"])
        assert "TOOLPOINT CALL WRONG" in said, numbers
        assert await mill.cnc.read_macros([513, 514]) == before
        await mill.linuxcnc.do(["mode", "MODE_MDI"], ["wait"])


async def test_an_operators_own_offset_stays_and_the_retreat_leaves_it(mill: Mill) -> None:
    await mill.write({"Z": 3.0})
    before = await mill.stands_mm()
    await mill.linuxcnc.mdi("G10 L2 P1 Z[#5223+0.5]")
    assert await mill.guard() is GuardStatus.APPLIED
    assert await mill.stands_mm() == pytest.approx(before + 0.5, abs=1e-7)
    for _ in range(2):
        await mill.write({})
        assert await mill.guard() is GuardStatus.APPLIED
    assert await mill.applied_um() == pytest.approx(0.0)
    assert await mill.stands_mm() == pytest.approx(WORK_MM + 0.5, abs=1e-7)


async def test_an_emergency_stop_is_an_alarm_and_a_restart_keeps_what_is_applied(mill: Mill) -> None:
    await mill.write({"Z": 2.0})
    assert await mill.guard() is GuardStatus.APPLIED
    applied = await mill.stands_mm()
    before = await mill.cnc.read([])
    await mill.linuxcnc.do(["state", "STATE_ESTOP"], ["wait"])
    assert (await mill.cnc.read([])).alarm
    await mill.linuxcnc.switch_on()
    assert await mill.stands_mm() == pytest.approx(applied, abs=1e-9)
    await mill.linuxcnc.mdi("M2")  # LinuxCNC writes its parameters
    await mill.stop()
    await mill.start()
    after = await mill.cnc.read([500, 512])
    assert after.power_on_count != before.power_on_count and after.macros == {500: 0.0, 512: None}
    assert await mill.guard() is GuardStatus.DISABLED
    assert await mill.applied_um() == pytest.approx(2.0)
    assert await mill.stands_mm() == pytest.approx(applied, abs=1e-6)


async def test_without_its_memory_it_moves_nothing(mill: Mill) -> None:
    before = await mill.stands_mm()
    await mill.linuxcnc.mdi(f"#{memory_of(CONFIG.guard, AXES)[-2]}=0")
    await mill.write({"Z": 4.0})
    echo_before = (await mill.cnc.read_macros([513]))[513]
    await mill.linuxcnc.mdi("o<toolpoint> call [1]")
    assert await mill.stands_mm() == pytest.approx(before, abs=1e-9)
    assert (await mill.cnc.read_macros([513]))[513] == echo_before, "it echoes nothing that it does not know"


async def test_a_step_that_is_not_settled_is_forgotten_only_when_a_person_says_so() -> None:
    async with started() as mill:
        await mill.linuxcnc.mdi("o<toolpoint> call [5]")
        pending, planned = memory_of(CONFIG.guard, AXES)[:2]
        await mill.linuxcnc.mdi(f"#{planned}=0.002", f"#{pending}=3", "G10 L2 P1 Z-100")
        for call, status in {"[5]": GuardStatus.UNSETTLED, "[5] [1]": GuardStatus.DISABLED}.items():
            await mill.linuxcnc.mdi(f"o<toolpoint> call {call}")
            await mill.linuxcnc.do(["mode", "MODE_MDI"], ["wait"])
            await mill.write({}, enable=4.0 if status is GuardStatus.UNSETTLED else 0.0)
            assert await mill.guard() is status, call


async def test_a_machine_in_inches_is_not_written_to() -> None:
    async with started("inch") as mill:
        assert "LINEAR_UNITS" in mill.cnc.cannot[Capability.WRITE_MACROS]
        await mill.linuxcnc.mdi("o<toolpoint> call [5]", "G10 L2 P1 Z-100")
        stood_mm = await mill.stands_mm()
        with pytest.raises(NotSentError, match="LINEAR_UNITS"):
            await mill.write({"Z": 3.0})
        await mill.linuxcnc.mdi("o<toolpoint> call [1]")
        assert await mill.stands_mm() == pytest.approx(stood_mm, abs=1e-7)


async def test_no_mode_of_the_program_makes_another_offset_of_the_value() -> None:
    async with started() as mill:
        await mill.linuxcnc.mdi("o<toolpoint> call [5]", "G10 L2 P1 X-50 Y-20", "G0 X10 Y10")
        before = await mill.linuxcnc.position_mm()
        modes = {"G7": "G8", "G91": "G90", "G93": "G94", "G92 X1": "G92.1", "G10 L2 P1 R30": "G10 L2 P1 R0"}
        expected_um = 0.0
        for mode, back in modes.items():
            await mill.linuxcnc.mdi(mode)
            await mill.write(dict.fromkeys("XYZ", expected_um + 1.0))
            status = await mill.guard()
            assert status is (GuardStatus.MODAL if mode == "G7" else GuardStatus.APPLIED), mode
            expected_um += status is GuardStatus.APPLIED
            await mill.linuxcnc.mdi(back, f"G0 X10 Y10 Z{WORK_MM}")
            moved_mm = [a - b for a, b in zip(await mill.linuxcnc.position_mm(), before, strict=True)]
            assert moved_mm == pytest.approx([expected_um / 1000.0] * 3, abs=1e-7), mode
            assert await mill.applied_um() == pytest.approx(expected_um), mode


async def test_a_block_left_half_written_expires_into_no_mode_in_which_a_whole_one_would_not() -> None:
    async with started(on_expiry="zero") as mill:
        await mill.linuxcnc.mdi("o<toolpoint> call [5]", "G10 L2 P1 X-50")
        await mill.write({"X": 2.0})
        assert await mill.guard() is GuardStatus.APPLIED
        await mill.write({"X": 2.0}, valid_s=-1.0)
        await mill.cnc.write_macros([[(500, mill.sequence + 1.0)]])
        stood_mm = (await mill.linuxcnc.position_mm())[0]
        for mode, back in {"G7": "G8", "G55": "G54"}.items():
            await mill.linuxcnc.mdi(mode)
            assert await mill.guard() is GuardStatus.MODAL, mode
            await mill.linuxcnc.mdi(back, "G0 X0")
            assert (await mill.linuxcnc.position_mm())[0] == pytest.approx(-50.0 + 0.002, abs=1e-7), mode
        await mill.cnc.write_macros([[(504, 2.5)]])
        assert await mill.guard() is GuardStatus.OVERSIZE, "what is no number of bits is left alone"
        await mill.cnc.write_macros([[(504, 7.0)]])
        assert await mill.guard() is GuardStatus.EXPIRED
        await mill.linuxcnc.mdi("G0 X0")
        assert (await mill.linuxcnc.position_mm())[0] == pytest.approx(-50.0, abs=1e-7) and stood_mm == 0.0


REQUEST = {"counter": 517, "kind": 518, "axis": 519, "value_mm": 520, "acknowledge": 508}
PASSED = f"""G21 G90 G40 G80 G54
G0 X0 Y0 Z{WORK_MM}
o<toolpoint> call [2] [1] [0]
o<toolpoint> call [1]
o<toolpoint> call [1]
G0 Z{WORK_MM + 30}
G0 Z{WORK_MM + 40}
G4 P0.2
M2
"""


@pytest.mark.parametrize("stands_mm", [WORK_MM + 15, WORK_MM])
async def test_a_run_from_line_behind_them_asks_nothing_and_hides_nothing_that_is_applied(stands_mm: float) -> None:
    """Where the axes stand as the program takes them to be, nothing tells LinuxCNC's program that it is passed."""
    async with started(request=REQUEST, request_timeout_s=0.5, on_timeout="continue") as mill:
        linuxcnc, told = mill.linuxcnc, Pins.of(config(request=REQUEST)).outputs
        await linuxcnc.mdi("o<toolpoint> call [5]")
        await mill.write({"Z": 2.0})
        assert await mill.guard() is GuardStatus.APPLIED
        await mill.write({"Z": -20.0})
        part = linuxcnc.directory / "o1000.ngc"
        part.write_text(PASSED, encoding="ascii")
        await linuxcnc.mdi(f"G0 X0 Y0 Z{stands_mm}")
        stood_mm = (await linuxcnc.position_mm())[2] - stands_mm
        assert stood_mm == pytest.approx(0.002, abs=1e-7)
        await linuxcnc.do(["mode", "MODE_AUTO"], ["wait"], ["program_open", str(part)], ["wait"])
        await linuxcnc.do(["auto", "AUTO_RUN", 7], ["pass"])
        moved_mm = (await linuxcnc.position_mm())[2] - (WORK_MM + 40)
        pins = [float(linuxcnc.halcmd("getp", f"motion.analog-out-{told[n]:02d}")) for n in (512, 517, 518)]
        assert pins[0] == pytest.approx(moved_mm, abs=1e-7), "the echo says what is applied"
        if stands_mm != WORK_MM:
            assert moved_mm == pytest.approx(stood_mm, abs=1e-7) and pins[1:] == [0.0, 0.0]
            assert "TOOLPOINT PASSED IN RUN FROM LINE" in (await linuxcnc.do(["messages"]))[0]
        await linuxcnc.do(["auto", "AUTO_RUN", 0], ["pass"])
        assert float(linuxcnc.halcmd("getp", f"motion.analog-out-{told[517]:02d}")) == pins[1] + 1.0, (
            "run whole it asks"
        )


async def test_a_preview_of_a_program_that_asks_ends(tmp_path: Path) -> None:
    """As the screens of LinuxCNC show a program when it is loaded: by an interpreter to which nobody answers."""
    (tmp_path / "toolpoint.ngc").write_text(linuxcnc_text(config(request=REQUEST), AXES), encoding="ascii")
    (tmp_path / "part.ngc").write_text(PASSED, encoding="ascii")
    (tmp_path / "mill.tbl").write_text("T1 P1 Z0 D1\n", encoding="ascii")
    (tmp_path / "mill.var").touch()
    ini = "[RS274NGC]\nSUBROUTINE_PATH = .\n[TRAJ]\nLINEAR_UNITS = mm\nCOORDINATES = X Y Z\n"
    (tmp_path / "mill.ini").write_text(ini, encoding="ascii")
    command = ["rs274", "-g", "-i", "mill.ini", "-t", "mill.tbl", "-v", "mill.var", "part.ngc"]
    shown = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=20, check=True).stdout
    assert shown.count("STRAIGHT_TRAVERSE") == 3 and "PROGRAM_END" in shown


async def test_an_abort_in_the_middle_of_the_guard_is_told_by_its_status() -> None:
    """Whenever it comes, the axes stand where the echo says, or the status says that it may lack a step."""
    async with started() as mill:
        linuxcnc, echo = mill.linuxcnc, []
        await linuxcnc.mdi("o<toolpoint> call [5]")
        part = linuxcnc.directory / "o1000.ngc"
        part.write_text("G21 G90 G40 G80 G54\n" + "o<toolpoint> call [1]\n" * 30 + "M2\n", encoding="ascii")
        for turn in range(24):
            await mill.write(dict.fromkeys("XYZ", 20.0 if turn % 2 else -20.0))
            await linuxcnc.do(["mode", "MODE_AUTO"], ["wait"], ["program_open", str(part)], ["wait"])
            await linuxcnc.do(["auto", "AUTO_RUN", 0])
            await asyncio.sleep(0.15 + 0.013 * turn)
            await linuxcnc.do(["abort"], ["wait"], ["mode", "MODE_MDI"], ["wait"])
            await linuxcnc.mdi("G21 G90 G54", f"G0 X0 Y0 Z{WORK_MM}")
            stands = [mm * 1000.0 for mm in await linuxcnc.position_mm()]
            told = await mill.cnc.read_macros([510, 511, 512, 514])
            applied = [stands[0], stands[1], stands[2] - WORK_MM * 1000.0]
            off_um = max(abs(um - (told[n] or 0.0) * 1000.0) for um, n in zip(applied, (510, 511, 512), strict=True))
            assert off_um < 1e-3 or told[514] == GuardStatus.UNFINISHED, (turn, applied, told)
            assert off_um < 3.001
            echo.append(told[514])
        assert GuardStatus.UNFINISHED in echo and GuardStatus.APPLIED in {await mill.guard()}


async def test_a_request_without_its_number_is_none() -> None:
    pin = f"motion.analog-out-{Pins.of(config(request=REQUEST)).outputs[517]:02d}"
    async with started(request=REQUEST, request_timeout_s=1.0, on_timeout="continue") as mill:
        await mill.linuxcnc.mdi("o<toolpoint> call [5]", "M61 Q1")
        taken = 0
        for numbers, asks in {
            "[2] [3]": False,
            "[2] [3] [0.00001]": True,
            "[3]": False,
            "[3] [0] [7]": True,
            "[3] [0] [0]": False,
            "[1]": True,
        }.items():
            await mill.linuxcnc.mdi(f"o<toolpoint> call [2] {numbers}")
            (*_, said) = await mill.linuxcnc.do(["messages"])
            taken += asks
            assert float(mill.linuxcnc.halcmd("getp", pin)) == taken, numbers
            assert ("TOOLPOINT REQUEST WRONG" in said) is not asks, numbers
            await mill.linuxcnc.do(["mode", "MODE_MDI"], ["wait"])
        await mill.linuxcnc.mdi("M61 Q0", "o<toolpoint> call [2] [3] [0] [0]")
        assert float(mill.linuxcnc.halcmd("getp", pin)) == taken + 1, "the spindle is empty"


async def test_what_is_measured_far_from_where_the_guard_was_called_is_not_asked_for() -> None:
    """Work that is positioned there would be 2 um beside as soon as the guard is called."""
    pin = f"motion.analog-out-{Pins.of(config(request=REQUEST)).outputs[517]:02d}"
    async with started(request=REQUEST, request_timeout_s=0.2, on_timeout="continue") as mill:
        await mill.linuxcnc.mdi("o<toolpoint> call [5]")
        await mill.write({"S": 20.0}, enable=15.0)
        for _ in range(3):
            await mill.guard()
        taken = 0
        for at_mm, numbers, asks in ((50, "[1]", True), (100, "[1]", False), (100, "[2] [3] [0.004]", False)):
            await mill.linuxcnc.mdi(f"G0 Z{at_mm}", f"o<toolpoint> call [2] {numbers}")
            (*_, said) = await mill.linuxcnc.do(["messages"])
            taken += asks
            assert float(mill.linuxcnc.halcmd("getp", pin)) == taken, numbers
            assert ("TOOLPOINT CALL GUARD HERE" in said) is not asks, numbers
            await mill.linuxcnc.do(["mode", "MODE_MDI"], ["wait"])
        for _ in range(4):
            await mill.guard()
        await mill.linuxcnc.mdi("o<toolpoint> call [2] [1]")
        assert float(mill.linuxcnc.halcmd("getp", pin)) == taken + 1, "the guard was called there"
