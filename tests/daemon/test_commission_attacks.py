"""What a commissioning finds wrong, and how it leaves the machine: over real OPC UA."""

import asyncio
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import pytest_asyncio
from commissioning_bench import STOPPED, Bench, Person, refused, serving, set_back
from control_rig import record_for

from config.machines import shipped_file
from config.records.commissioning import CommissionedAxis
from config.records.commissioning_file import save_commissioning
from daemon.commissioning.initialising import CommissioningRefusedError, ForeignWriterError
from daemon.commissioning.movement import DISPROVED
from daemon.commissioning.session import Sources
from daemon.history.database import HistoryError
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from drivers.contract import LinkError
from drivers.sim.nc.wiring import Wiring
from models.records import WriteOutcome

pytestmark = pytest.mark.asyncio(loop_scope="module")
bench = set_back

REVERSED = Wiring(um_per_um={"z": {"z": -1.0}})
SWAPPED = Wiring(um_per_um={"z": {"y": 1.0}, "y": {"z": 1.0}})
INCH = Wiring(um_per_um={"z": {"z": 25.4}})
DIAMETER = Wiring(um_per_um={"x": {"x": 0.5}})
SKEW = Wiring(um_per_um={"z": {"z": 1.0, "x": 0.5}})


on_every_control = pytest.mark.parametrize(
    "served", ["opcua", "focas", "haas", "sinumerik"], indirect=True, scope="module"
)
"""What the wire or the text of the guard may do otherwise there."""


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=["opcua"])
async def served(tmp_path_factory, request):
    async with serving(tmp_path_factory.mktemp("attacks"), request.param) as bench:
        yield bench


class Obedient(Person):
    """Calls the guard by hand when told to, until so much is applied."""

    until_um = float("inf")

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self.calls: list[asyncio.Task[None]] = []

    async def call_guard_soon(self) -> None:
        await self.bench.clock.sleep(4.0)
        self.bench.call_guard()

    def say(self, text: str) -> None:
        super().say(text)
        if "Call the guard" in text and self.bench.machine.guard.applied_um["z"] < self.until_um:
            self.calls.append(asyncio.create_task(self.call_guard_soon()))


def naming(record_file):
    """Return the change of a configuration that makes this its commissioning record."""

    def change(content):
        content["compensation"]["commissioning_file"] = str(record_file)

    return change


def with_record_of_z(bench):
    """Return a record of z as it should move, and the change of a configuration that names it."""
    record_file = bench.directory / "record.json"
    known = CommissionedAxis(sign=1, scale=1.0, written_um=5.0, measured_um=5.0)
    save_commissioning(record_for(bench.configuration(), axes={"z": known}), record_file)
    return record_file, naming(record_file)


# --- what the readings show ------------------------------------------------------------


@pytest.mark.parametrize(
    ("wiring", "axis", "words"),
    [
        (REVERSED, "z", "doubles the error"),
        (SWAPPED, "z", "axis y by 5.00 um instead"),
        (INCH, "z", "taken for inches"),
        (DIAMETER, "x", "radius"),
        (SKEW, "z", "axis x by 2.50 um moved as well"),
    ],
)
async def test_a_machine_that_is_wired_wrongly_is_found_and_left_at_zero(bench, wiring, axis, words):
    bench.reset(wiring)
    said = await refused(bench, axes=(axis,))
    assert words in said and f"axis {axis}" in said
    assert bench.at_rest()


async def test_swapped_axes_are_found_without_an_instrument_at_the_other(bench):
    bench.reset(SWAPPED)
    person = Person(bench)
    person.eyes = lambda axis: bench.moved_um()[axis] if axis == "z" else None
    assert "look which axis moved" in await refused(bench, person, axes=("z",))
    assert bench.at_rest()


@on_every_control
async def test_a_reversed_sign_and_a_scale_are_recorded_only_when_a_person_accepts_them(bench):
    bench.reset(Wiring(um_per_um={"z": {"z": -2.0}}))
    both = {"accept_reversed": frozenset("z"), "accept_scale": frozenset("z")}
    record = await bench.commission(Person(bench), axes=("z",), **both)
    assert record is not None
    assert (record.axes["z"].sign, record.axes["z"].scale) == (-1, 2.0)
    bench.reset(INCH)
    assert "taken for inches" in await refused(bench, axes=("z",), **both)


@pytest.mark.parametrize(
    ("before", "words"), [((1, 1.0), "axis z, so it counts no more"), ((-1, 1.0), None), ((1, 2.0), "counts no more")]
)
async def test_a_record_of_before_that_the_machine_disproves_counts_no_more(bench, before, words):
    """The person gives up, and the next one switches on: a daemon with that record would double the error."""
    bench.reset(REVERSED)
    record_file = bench.directory / "record.json"
    sign, scale = before
    known = CommissionedAxis(sign=sign, scale=scale, written_um=5.0, measured_um=5.0 * sign * scale)
    save_commissioning(record_for(bench.configuration(), axes={"z": known}), record_file)

    named = naming(record_file)
    person = Person(bench)
    assert "doubles the error" in await refused(bench, person, axes=("z",), change=named)
    assert bench.at_rest()
    assert record_file.exists() == (words is None)
    assert words is None or words in person.text_said
    refusal = await refused(bench, axes=("z",), change=named)
    assert "doubles the error" in refusal, "the same again, with the record or without"


async def test_a_record_of_before_counts_no_more_where_another_axis_moves_the_one_it_is_of(bench):
    """What is written for y moves z, so what is written for z moves something else."""
    bench.reset(SWAPPED)
    record_file, named = with_record_of_z(bench)
    person = Person(bench)
    assert "axis z by 5.00 um instead" in await refused(bench, person, axes=("y",), change=named)
    assert not record_file.exists() and "in doubt for axis z, so it counts no more" in person.text_said


async def test_a_record_that_ships_with_toolpoint_is_refused_and_stays(bench):
    """It was renamed to .disproved, in the folder of the installation."""
    bench.reset(REVERSED)
    record_file = shipped_file("simulated_machine_commissioning.json")
    before = record_file.read_bytes()

    named = naming(record_file)
    try:
        assert "ships with Toolpoint and stays as it is: copy it" in await refused(bench, axes=("z",), change=named)
        assert bench.writes() == [] and record_file.read_bytes() == before
    finally:
        record_file.write_bytes(before)
        record_file.with_name(record_file.name + DISPROVED).unlink(missing_ok=True)


@pytest.mark.parametrize(("wiring", "replaces"), [(REVERSED, True), (REVERSED, False), (Wiring(), True)])
async def test_a_record_of_before_counts_no_more_where_an_axis_is_proved_to_move_otherwise(bench, wiring, replaces):
    """He accepts what z does now; then another axis is given up, or the new record lies beside the one of before."""
    bench.reset(wiring)
    record_file, named = with_record_of_z(bench)
    person = Person(bench)
    plan = {"accept_reversed": frozenset("z"), "change": named}
    if replaces:
        person.denies = "instrument along y in place"
        await refused(bench, person, axes=("z", "y"), **plan)
    else:
        assert await bench.commission(person, axes=("z",), replaces=False, **plan) is not None
    assert bench.at_rest()
    assert record_file.exists() is (wiring is not REVERSED)
    assert ("axis z, so it counts no more" in person.text_said) is (wiring is REVERSED)


@pytest.mark.parametrize(
    ("question", "words"), [("with the offset applied", "axis z, so it counts no more"), ("before", "")]
)
@pytest.mark.parametrize("way", ["Ctrl-C", "Enter", "no"])
async def test_a_record_of_before_counts_no_more_where_a_person_breaks_the_proof_off(bench, question, words, way):
    """He sees the axis go the wrong way: Ctrl-C before he has typed what is read, no reading, or not the one given."""
    bench.reset(REVERSED)
    record_file = bench.directory / "record.json"
    known = CommissionedAxis(sign=1, scale=1.0, written_um=5.0, measured_um=5.0)
    save_commissioning(record_for(bench.configuration(), axes={"z": known}), record_file)
    person, number = Person(bench), Person.number
    given = {("z", "z"): (0.0, 5.0, 0.0)} if way == "no" else {}

    async def breaks_off(text):
        if question in text and way == "Ctrl-C":
            raise asyncio.CancelledError
        return None if question in text else await number(person, text)

    named = naming(record_file)
    person.number, person.denies = breaks_off, question
    with pytest.raises(asyncio.CancelledError if way == "Ctrl-C" else CommissioningRefusedError):
        await bench.commission(person, axes=("z",), change=named, sources=Sources(given=given))
    assert bench.at_rest()
    assert record_file.exists() == (not words) and words in person.text_said


@pytest.mark.parametrize("guard_runs", [True, False])
async def test_a_record_of_before_counts_on_where_the_proof_is_broken_off_before_the_guard_has_moved_anything(
    bench, guard_runs
):
    bench.reset(program=STOPPED)
    record_file = bench.directory / "record.json"
    known = CommissionedAxis(sign=1, scale=1.0, written_um=5.0, measured_um=5.0)
    save_commissioning(record_for(bench.configuration(), axes={"z": known}), record_file)
    person = Obedient(bench)

    def breaks_off(text):
        if "The CNC holds z +" in text:
            if guard_runs:
                bench.call_guard()  # in the moment in which he presses Ctrl-C: no look has seen it yet
            raise asyncio.CancelledError

    named = naming(record_file)
    person.on_say = breaks_off
    with pytest.raises(asyncio.CancelledError):
        await bench.commission(person, axes=("z",), change=named)
    assert bench.at_rest()
    assert record_file.exists() is not guard_runs and ("counts no more" in person.text_said) is guard_runs


@pytest.mark.parametrize("guard_runs_again", [True, False])
async def test_an_echo_that_a_run_which_was_broken_off_left_behind_is_no_zero(bench, guard_runs_again):
    """RESET in the guard's run: the axis has moved, the echo says 0; then Ctrl-C."""
    bench.reset(program=STOPPED)
    person = Obedient(bench) if guard_runs_again else Person(bench)

    def breaks_off(text):
        if "run once" in text and not guard_runs_again:
            bench.call_guard()
        if "The CNC holds z +" in text:
            machine = bench.machine
            run = machine.guard.at(machine.nc.macros, machine.nc.clock_at(machine.time_s))
            run.start(machine.guard.programs.guard)
            while not machine.guard.applied_um["z"]:
                run.step()
            run.reset()
            raise asyncio.CancelledError

    person.on_say = breaks_off
    with pytest.raises(asyncio.CancelledError):
        await bench.commission(person, axes=("z",), patience_s=30.0)
    assert bench.at_rest() is guard_runs_again
    assert ("Everything is back at zero." in person.text_said) is guard_runs_again
    assert ("LEFT BEHIND: what the guard applies is not known (status 14)" in person.text_said) is not guard_runs_again


async def test_the_record_is_written_before_a_daemon_can_start(bench):
    """One that is started again and again beside the command would begin with the record of before."""
    refusals = []

    def save(record):
        with pytest.raises(HistoryError) as refusal:
            HistoryWriter(bench.store, clock=bench.clock, machine=MachineLayout.from_configuration(described)).start()
        refusals.append((tuple(record.axes), str(refusal.value)))

    described = bench.configuration()
    await bench.commission(Person(bench), axes=("z",), save=save)
    assert [axes for axes, _ in refusals] == [("z",)]


async def test_an_instrument_that_does_not_come_back_proves_nothing(bench):
    person = Person(bench)
    given = {("z", "z"): (0.0, 5.0, 1.5)}
    assert "drifts" in await refused(bench, person, axes=("z",), sources=Sources(given=given))
    assert bench.at_rest()


# --- the displacement channel ----------------------------------------------------------


async def log_rows(bench: Bench, path: Path, noise_um: float, late_rows: int = 0) -> None:
    """Write a logger's file: a row a second, in the layout of the configuration; so many rows wait to be written."""
    rng = np.random.default_rng(3)
    waiting: list[str] = []
    with path.open("w", encoding="utf-8") as file:
        file.write("time,Y1,Y2,Z1,Z2,Z3\n")
        while True:
            moment = bench.clock.now().utc_s
            moved = bench.moved_um()
            values = [moved["y"], moved["y"], moved["z"], moved["z"], moved["z"]]
            fields = [f"{um + noise_um * rng.standard_normal():.3f}" for um in values]
            waiting.append(f"{moment:.3f}," + ",".join(fields) + "\n")
            if len(waiting) > late_rows:
                file.write(waiting.pop(0))
            file.flush()
            await bench.clock.sleep(1.0)


def with_log(path: Path):
    def change(content):
        content["displacements"]["file"] = {
            "path": str(path),
            "header": "time",
            "time_format": "%s",
            "poll_period_s": 2.0,
        }

    return change


@pytest.mark.parametrize(("noise_um", "late_rows", "words"), [(0.1, 0, ""), (0.1, 25, ""), (1.5, 0, "scatters")])
async def test_a_displacement_channel_reads_unless_it_is_noisy(bench, tmp_path, noise_um, late_rows, words):
    path = tmp_path / "logger.csv"
    writing = asyncio.create_task(log_rows(bench, path, noise_um, late_rows))
    await bench.clock.sleep(4.0)
    work = {"axes": ("z",), "sources": Sources(channels={"z": "Z1", "y": "Y1"}, samples=8), "change": with_log(path)}
    person = Person(bench)
    person.eyes = lambda axis: None
    try:
        if words:
            assert words in await refused(bench, person, **work)
        else:
            record = await bench.commission(person, **work)
            assert record is not None
            found = record.axes["z"]
            assert found.measured_um == pytest.approx(5.0, abs=0.3)
            assert found.others_um == pytest.approx({"y": 0.0}, abs=0.3)
            assert found.readings is not None and found.readings.samples == 8
            assert found.readings.noise_um == pytest.approx(0.1, abs=0.09)
            assert found.readings.source == "displacement channel Z1"
    finally:
        writing.cancel()
        await asyncio.gather(writing, return_exceptions=True)
    assert bench.at_rest()


# --- the guard -------------------------------------------------------------------------


@pytest.mark.parametrize("left_s", [None, 90_000.0])
async def test_a_guard_that_is_never_called_moves_nothing(bench, left_s):
    """Also where its echo is of before the control was switched off, when its clock stood higher than now."""
    bench.reset(program=STOPPED)
    if left_s is not None:
        bench.machine.nc.macros.set(bench.configuration().cnc.macros.echo_time, left_s)
    person = Person(bench)
    said = await refused(bench, person, axes=("z",), patience_s=10.0)
    assert "it has not run" in said and "really calls it" in said
    assert "Nothing has been moved" in person.text_said
    assert bench.at_rest()
    assert {value for write in bench.writes() for _, value in write.macros} <= {0.0}, "only initialised"


async def test_a_guard_that_makes_no_check_is_refused_before_anything_moves(bench, monkeypatch):
    bench.reset(program=STOPPED)
    echoed, call = bench.configuration().cnc.macros.echo_guard_version, bench.call_guard

    def call_an_older_guard() -> None:
        call()
        bench.machine.nc.macros.set(echoed, 1.0)

    monkeypatch.setattr(bench, "call_guard", call_an_older_guard)
    person = Obedient(bench)
    said = await refused(bench, person, axes=("z",))
    assert "the control runs guard version 1, which applies a block whose check does not fit" in said
    assert "Nothing has been moved" in person.text_said and bench.at_rest()


@on_every_control
async def test_a_guard_without_memory_asks_for_its_initialise_program(bench):
    bench.reset(program=STOPPED)
    macros = bench.configuration().cnc.macros
    for number in macros.echo_applied.values():
        bench.machine.nc.macros.set(number, None)
    person = Obedient(bench)

    def initialise(text: str) -> None:
        if "initialise program" in text:
            nc = bench.machine.nc
            bench.machine.guard.initialise(nc.macros, nc.clock_at(bench.machine.time_s))
            bench.call_guard()

    person.on_say = initialise
    record = await bench.commission(person, axes=("z",))
    assert record is not None
    assert "its echo of what is applied is vacant" in person.text_said
    assert bench.at_rest()


@on_every_control
async def test_a_guard_that_stops_being_called_with_an_offset_applied_is_left_and_said(bench):
    bench.reset(program=STOPPED)
    person = Obedient(bench)
    person.until_um = 4.9
    await refused(bench, person, axes=("z",), patience_s=10.0)
    assert "LEFT BEHIND: the guard applies 5.00 um along z" in person.text_said
    values = bench.configuration().cnc.macros
    assert bench.macro(values.values["z"]) == 0.0
    assert bench.macro(values.enable) == 4.0, "an echo that is not zero is not switched off silently"
    # A second commissioning takes the offset back first.
    again = Obedient(bench)
    assert await bench.commission(again, axes=("z",)) is not None
    assert any("still applies an offset" in question for question in again.asked)
    assert bench.at_rest()


async def test_a_reading_while_the_axis_is_not_where_it_was_asked_to_be_is_refused(bench):
    bench.reset(program=STOPPED)
    person = Obedient(bench)
    person.when_applied("z", lambda: bench.machine.guard.place(bench.machine.nc.macros, {"z": 4.0}))
    sentence = await refused(bench, person, axes=("z",))
    assert "axis z: the guard did not apply what was asked while the instrument was read with the offset" in sentence
    assert "Everything is back at zero" in person.text_said and bench.at_rest()


# --- links, signals, strangers ---------------------------------------------------------


@on_every_control
async def test_a_link_that_is_lost_in_the_middle_is_built_anew_to_go_back(bench):
    person, cuts = Person(bench), []

    async def cut() -> None:
        await bench.relay.stop()
        await bench.clock.sleep(20.0)
        await bench.relay.start()

    person.when_applied("z", lambda: cuts.append(asyncio.create_task(cut())), wait_s=20.0)
    with pytest.raises(LinkError):
        await bench.commission(person, axes=("z",))
    assert cuts and "Everything is back at zero" in person.text_said
    assert bench.at_rest()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_an_interrupt_takes_the_offset_back(bench, number):
    person = Person(bench)
    person.when_applied("z", lambda: os.kill(os.getpid(), number))
    with pytest.raises(asyncio.CancelledError):
        await bench.commission(person, axes=("z",))
    assert "Stopped (interrupted)" in person.text_said and "Everything is back at zero" in person.text_said
    assert bench.at_rest()
    unfinished = [write for write in bench.writes() if write.outcome is WriteOutcome.INTENDED]
    assert not unfinished


async def test_a_second_interrupt_leaves_the_machine_and_says_so(bench):
    bench.reset(program=STOPPED)
    person = Obedient(bench)
    person.until_um = 4.9
    person.when_applied("z", lambda: os.kill(os.getpid(), signal.SIGINT))

    def impatient(text: str) -> None:
        if "Call the guard" in text and "zero" in text:
            os.kill(os.getpid(), signal.SIGINT)

    person.on_say = impatient
    with pytest.raises(asyncio.CancelledError):
        await bench.commission(person, axes=("z",))
    assert "broke off: interrupted" in person.text_said and "LEFT BEHIND: the guard applies 5.00 um" in person.text_said
    # The block expires; whoever commissions next takes the offset back before anything else.
    await bench.clock.sleep(130.0)
    again = Obedient(bench)
    assert await bench.commission(again, axes=("z",)) is not None
    assert bench.at_rest()


@on_every_control
async def test_a_second_writer_ends_everything_without_another_write(bench):
    person = Person(bench)
    number = bench.configuration().cnc.macros.values["z"]
    person.when_applied("z", lambda: bench.machine.nc.macros.set(number, 0.025), wait_s=8.0)
    with pytest.raises(ForeignWriterError, match=f"#{number}"):
        await bench.commission(person, axes=("z",))
    assert "nothing more is written" in person.text_said and "LEFT BEHIND" in person.text_said
    assert bench.macro(number) == 0.025


@on_every_control
@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (lambda machine: setattr(machine.nc, "alarm", 1), "alarm is active"),
        (lambda machine: machine.power_cycle(), "switched off and on"),
    ],
)
async def test_what_happens_at_the_control_in_the_middle_takes_the_offset_back(bench, happens, words):
    person = Person(bench)
    person.when_applied("z", lambda: happens(bench.machine), wait_s=8.0)
    if (
        bench.driver not in ("opcua", "sinumerik") and words == "switched off and on"
    ):  # it drops its sessions: the link is what is lost
        with pytest.raises(LinkError, match="ended the connection"):
            await bench.commission(person, axes=("z",))
    else:
        assert words in await refused(bench, person, axes=("z",))
    assert "Everything is back at zero" in person.text_said
    assert bench.at_rest()
