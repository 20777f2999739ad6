"""The text of the NC programs: what a control takes, what the configuration decides, and the sheet with it."""

import re
from typing import Any

import pytest
from guard_bench import AXES, MAP, GuardBench
from pydantic import ValidationError
from shipped_machine import shipped_machine

from config.schema import Configuration
from config.schema.cnc import CncConfig
from config.schema.guard import PROGRAM_LABELS, VACANT_R, GuardConfig
from drivers.guard.check import block_check
from drivers.guard.programs import guard_program, guard_text
from drivers.guard.sheet import guard_sheet
from drivers.guard.text import GuardPrograms, GuardStatus, GuardTextError, guard_digest
from drivers.sim.nc.custom_macro import compile_programs

GUARD = GuardConfig(increment_mm=0.0001)


@pytest.fixture(scope="module")
def shipped() -> Configuration:
    return shipped_machine()


def test_the_text_holds_only_what_a_control_takes(shipped: Configuration) -> None:
    text = guard_program(shipped)
    lines = text.splitlines()
    assert (lines[0], lines[-1]) == ("%", "%")
    assert text.isascii()
    assert all(len(line) <= 76 for line in lines)
    for line in lines[1:-1]:
        bare = re.sub(r"\([A-Z0-9 .,\-=/#+]*\)", "", line)
        assert re.fullmatch(r"[A-Z0-9#\[\]=+\-*/.]*", bare), line
        assert line.count("(") == line.count(")") <= 1


def test_every_program_can_be_compiled_and_every_label_is_jumped_to(shipped: Configuration) -> None:
    programs = compile_programs(guard_program(shipped))
    assert set(programs) == {9010, 9011, 9012}
    text = guard_program(shipped)
    for number, program in programs.items():
        part = text.split(f"O{number}(", 1)[1].split("\nO9", 1)[0]
        jumps = {int(label) for label in re.findall(r"GOTO(\d+)", part)} | {*range(90903, 90911)}
        assert set(program.labels) <= jumps | {90300, 90600}, number
        assert set(program.labels) <= set(PROGRAM_LABELS), number


def test_only_macros_of_the_map_and_of_the_memory_are_written(shipped: Configuration) -> None:
    macros, memory = shipped.cnc.macros, shipped.cnc.guard.memory_of(3)
    written = {int(n) for n in re.findall(r"(?:^|N\d+|THEN)#(\d+)=", guard_program(shipped), re.MULTILINE)}
    commons = {number for number in written if number >= 34 and number not in (3000, 3006)}
    request = set(macros.request_macros.values()) - {macros.request_macros["acknowledge"]}
    echo = {*macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version}
    assert commons == {*memory, *echo, *request, macros.valid_until}


def test_the_simulated_control_runs_the_very_text(shipped: Configuration) -> None:
    bench = GuardBench()
    assert bench.nc.text == guard_text(MAP, AXES, GUARD)
    from drivers.sim.nc.safe_point import SafePointApplication

    running = SafePointApplication(shipped.cnc.macros, shipped.compensation.axes, shipped.cnc.guard)
    named = guard_program(shipped).replace(f"(MACHINE {shipped.machine.upper()})", "(MACHINE NOT NAMED)")
    assert running.text == named


def test_the_digest_knows_every_number(shipped: Configuration) -> None:
    digests = {guard_digest(guard_text(MAP, AXES, GUARD))}
    changes: list[dict[str, Any]] = [
        {"max_validity_s": 60.0},
        {"increment_mm": 0.001},
        {"on_expiry": "zero"},
        {"alarm": "stop"},
        {"memory": 700},
        {"program": 8000},
        {"read_ahead_stop": "M150"},
    ]
    for change in changes:
        digests.add(guard_digest(guard_text(MAP, AXES, GuardConfig(**({"increment_mm": 0.0001} | change)))))
    axes = AXES | {"z": AXES["z"].model_copy(update={"absolute_bound_um": 79.0})}
    digests.add(guard_digest(guard_text(MAP, axes, GUARD)))
    digests.add(guard_digest(guard_text(MAP.model_copy(update={"unit_um": 1.0}), AXES, GUARD)))
    assert len(digests) == len(changes) + 3
    assert re.search(r"^\(TEXT [0-9A-F]{16} MAP [0-9A-F]{16}\)$", guard_program(shipped), re.MULTILINE)


@pytest.mark.parametrize("unit_um", [1000.0, 1.0, 0.1, 25400.0])
def test_the_unit_of_the_macros_is_respected(unit_um: float) -> None:
    from drivers.sim.nc.nc import MacroTable
    from drivers.sim.nc.safe_point import SafePointApplication

    macro_map = MAP.model_copy(update={"unit_um": unit_um})
    macros, nc = MacroTable(), SafePointApplication(macro_map, AXES, GUARD)
    nc.initialise(macros, 10.0)
    for number, value in ((500, 1.0), (503, -7.3 / unit_um), (120, 30.0), (504, 4.0), (505, 1.0)):
        macros.set(number, value)
    macros.set(506, 1.0 + 4.0 + 300.0 - 3.0 * 7300.0)
    assert nc.run(macros, 11.0) is GuardStatus.APPLIED
    assert nc.applied_um["z"] == pytest.approx(-7.3)
    assert macros.get(513) == pytest.approx(-7.3 / unit_um)
    assert nc.run(macros, 12.0) is GuardStatus.APPLIED
    assert nc.applied_um["z"] == pytest.approx(-7.3)


def test_axes_are_told_from_their_names_or_by_the_configuration() -> None:
    named = {"Z1": AXES["z"]}
    with pytest.raises(GuardTextError, match="Z1 is not x, y or z"):
        guard_text(MAP, named, GUARD)
    text = guard_text(
        MAP.model_copy(update={"values": {"Z1": 503}, "echo_applied": {"Z1": 513}}),
        named,
        GuardConfig.model_validate({"axes": {"Z1": {"letter": "W", "number": 4}}}),
    )
    assert "L2P0W[#5204+#21]" in text
    with pytest.raises(GuardTextError, match="letter Z stands for more than one axis"):
        guard_text(MAP, AXES, GuardConfig.model_validate({"axes": {"x": {"letter": "Z", "number": 1}}}))
    with pytest.raises(ValidationError, match="is z already"):
        GuardConfig.model_validate({"axes": {"z": {"letter": "Z", "number": 3}, "w": {"letter": "W", "number": 3}}})


@pytest.mark.parametrize(
    "change,sentence",
    [
        ({"memory": 520}, "#520 .* is in the macro map or in `writable` already"),
        ({"memory": 511}, "#511"),
        ({"memory": 995}, "there are macros up to #999"),
        ({"read_ahead_stop": "M30"}, "ends or calls a program"),
        ({"read_ahead_stop": "G04"}, "should match pattern"),
        ({"on_expiry": "retreat"}, "keep"),
    ],
)
def test_settings_that_cannot_be(shipped: Configuration, change: dict[str, Any], sentence: str) -> None:
    content = shipped.cnc.model_dump() | {"guard": shipped.cnc.guard.model_dump() | change}
    with pytest.raises(ValidationError, match=sentence):
        CncConfig.model_validate(content)


def test_programs_that_the_map_has_no_macros_for_are_left_out() -> None:
    assert GuardPrograms.of(MAP, GUARD) == GuardPrograms(
        guard=9010, initialise=9011, request=None, enter=None, leave=None
    )
    flagged = MAP.model_copy(update={"safe_flag": 130})
    assert set(compile_programs(guard_text(flagged, AXES, GUARD))) == {9010, 9011, 9013, 9014}


@pytest.mark.parametrize("dialect", ["fanuc", "sinumerik"])
def test_what_the_sheet_says_of_the_tests_is_what_happens(dialect: str) -> None:
    """Rows that set macros alone are carried out; the others need a hand on the control."""
    configuration = shipped_machine()
    guard = configuration.cnc.guard.model_copy(update={"dialect": dialect})
    configuration = configuration.model_copy(update={"cnc": configuration.cnc.model_copy(update={"guard": guard})})
    rows = next(section for section in guard_sheet(configuration) if section.title.startswith("Try")).rows
    bench = GuardBench(dialect=dialect)
    vacant = "#0" if dialect == "fanuc" else f"{VACANT_R:.0f}"
    value_of = rf"(?:#|\bR)(\d+)=(V|C|{vacant}|-?[\d.]+)"
    carried_out = 0
    for _, settings, expected, _ in rows:
        if re.fullmatch(rf"({value_of} ?)+", settings) is None and settings != "guard called again":
            break
        before = list(bench.nc.control.external_mm)
        for number, value in re.findall(value_of, settings):
            check = block_check(MAP, AXES, {number: bench.macros.get(number) for number in MAP.block})
            found = {"V": bench.clock_s + 60.0, "C": check, vacant: None}.get(value, 0.0)
            bench.macros.set(int(number), float(value) if found == 0.0 else found)
        shown = bench.nc.control.messages_shown
        bench.call(later_s=1.0)
        for number, value in re.findall(r"(?:#|\bR)(\d+)=(-?[\d.]+)\b", expected):
            assert bench.macros.get(int(number)) == pytest.approx(float(value)), (settings, expected)
        if "as before" in expected:
            assert bench.nc.control.external_mm == before, settings
        if "message" in expected:
            assert (bench.nc.control.messages_shown > shown) is ("no message" not in expected), settings
        carried_out += 1
    assert carried_out == 9
