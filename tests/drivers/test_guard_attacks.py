"""The shipped text of the guard under attack: everything that could make it move the tool wrongly."""

import itertools
from collections import Counter

import guard_bench
import pytest
from guard_bench import AXES, CLOCK_S, MAP, GuardBench

from drivers.guard.check import block_check
from drivers.sim.nc.safe_point import GuardStatus

MEMORY = range(590, 597)
READS = 8
"""Macros that the guard reads from the block, and that the daemon writes."""


@pytest.fixture(params=["fanuc", "sinumerik"], autouse=True)
def dialect(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both texts are held to the same."""
    monkeypatch.setattr(guard_bench, "DIALECT", request.param)
    return str(request.param)


@pytest.fixture
def bench(dialect: str) -> GuardBench:
    return GuardBench(own_um={"x": 12.0, "y": -250.0, "z": 1234.5})


def test_adds_to_the_operators_own_offset(bench: GuardBench) -> None:
    bench.write(x=1.0, y=-2.0, z=3.0)
    assert bench.call() is GuardStatus.APPLIED
    assert bench.nc.control.external_mm == pytest.approx([0.013, -0.252, 1.2375])
    assert bench.applied_um == pytest.approx({"x": 1.0, "y": -2.0, "z": 3.0})
    assert bench.settled()


def test_an_offset_that_the_operator_changes_between_two_calls_stays_his(bench: GuardBench) -> None:
    bench.write(z=5.0)
    bench.call()
    bench.nc.change_own_offset("z", -300.0)
    bench.write(z=7.0)
    assert bench.call() is GuardStatus.APPLIED
    assert bench.applied_um["z"] == pytest.approx(7.0)
    assert bench.nc.control.external_mm[2] == pytest.approx(1.2345 - 0.3 + 0.007)


def test_an_offset_changed_in_the_middle_of_the_guard_is_never_written_over() -> None:
    seen = set()
    for at in itertools.count():
        bench = GuardBench(own_um={"z": 100.0})
        bench.write(z=5.0)
        changes: list[None] = []
        status = bench.with_interference(
            at, lambda bench=bench, changes=changes: changes.append(bench.nc.change_own_offset("z", 40.0))
        )
        if not changes:
            break
        seen.add(status)
        assert bench.applied_um["z"] == pytest.approx(5.0)
        assert bench.nc.control.external_mm[2] == pytest.approx(0.145)
    assert seen == {GuardStatus.APPLIED, GuardStatus.UNSETTLED}


def test_after_twenty_minutes_without_a_call_an_old_block_has_expired(bench: GuardBench) -> None:
    bench.write(z=3.0)
    assert bench.call(later_s=1200.0) is GuardStatus.EXPIRED
    assert bench.applied_um["z"] == 0.0
    assert bench.message == "TOOLPOINT EXPIRED"


@pytest.mark.parametrize("valid_until", [None, CLOCK_S - 5.0, CLOCK_S, CLOCK_S + 120.1, CLOCK_S + 1e7, -3.0])
@pytest.mark.parametrize("policy", ["keep", "zero"])
def test_expired(policy: str, valid_until: float | None) -> None:
    bench = GuardBench(on_expiry=policy)
    bench.write(x=4.0, z=17.0)
    bench.call()
    bench.call()
    bench.write(x=-4.0, z=40.0)
    bench.macros.set(MAP.valid_until, valid_until)
    reached = []
    for _ in range(3):
        assert bench.call() is GuardStatus.EXPIRED
        assert bench.message == "TOOLPOINT EXPIRED"
        assert bench.settled()
        reached.append((bench.applied_um["x"], bench.applied_um["z"]))
    zero = [(0.0, 7.0), (0.0, 0.0), (0.0, 0.0)]
    assert reached == [pytest.approx(row) for row in (zero if policy == "zero" else [(4.0, 17.0)] * 3)]


@pytest.mark.parametrize("enable", [1.0, 2.0, 4.0, 5.0, 6.0])
def test_foreign_enable_bits_do_not_decide_which_axes_an_expired_block_takes_back(enable: float) -> None:
    bench = GuardBench(own_um={"y": 30.0}, on_expiry="zero")
    bench.write(x=4.0, y=-3.0, z=17.0)
    bench.call()
    bench.call()
    bench.macros.set(MAP.enable, enable)
    bench.clock_s += 60.0
    reached = []
    for _ in range(3):
        assert bench.call() is GuardStatus.EXPIRED and bench.settled()
        reached.append(list(bench.applied_um.values()))
    assert reached == [pytest.approx(row) for row in ((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))]


def test_with_all_bits_off_nothing_alarms_whatever_else_is_wrong(bench: GuardBench) -> None:
    bench.write(z=5.0)
    bench.call()
    bench.write(z=-70.0, enable=0.0, valid_for_s=None)
    bench.macros.set(MAP.values["x"], None)
    bench.macros.set(MAP.echo_applied["x"], None)
    bench.modal(6, 20)
    assert bench.call(later_s=500.0) is GuardStatus.DISABLED
    assert bench.applied_um["z"] == pytest.approx(5.0)
    assert not bench.message


def test_a_disabled_axis_stays_where_it_is_while_others_follow(bench: GuardBench) -> None:
    bench.write(x=2.0, z=5.0)
    bench.call()
    bench.write(x=0.0, z=8.0, enable=0b100)
    assert bench.call() is GuardStatus.APPLIED
    assert bench.applied_um == pytest.approx({"x": 2.0, "y": 0.0, "z": 8.0})


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("beyond", [1.001, 2.0, 1e6, -1.001, -50.0])
def test_oversize_refuses_the_whole_block(axis: str, beyond: float) -> None:
    bench = GuardBench()
    bench.write(**({"x": 1.0, "y": 1.0, "z": 1.0} | {axis: AXES[axis].absolute_bound_um * beyond}))
    assert bench.call() is GuardStatus.OVERSIZE
    assert bench.applied_um == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert bench.message == "TOOLPOINT OVERSIZE VALUE"


@pytest.mark.parametrize("enable", [-1.0, 8.0, 255.0, 3.5])
def test_an_enable_word_with_bits_of_no_axis_is_refused(bench: GuardBench, enable: float) -> None:
    bench.write(z=1.0, enable=enable)
    assert bench.call() is GuardStatus.OVERSIZE
    assert bench.applied_um["z"] == 0.0


@pytest.mark.parametrize(
    "number,expected",
    [
        (MAP.sequence_a, GuardStatus.TORN),
        (MAP.sequence_b, GuardStatus.TORN),
        *((number, GuardStatus.VACANT) for number in (*MAP.values.values(), MAP.enable)),
        (MAP.valid_until, GuardStatus.EXPIRED),
        (MAP.check, GuardStatus.CHECK),
        *((number, GuardStatus.MEMORY) for number in MAP.echo_applied.values()),
        (MAP.echo_time, GuardStatus.APPLIED),
        (MAP.echo_status, GuardStatus.APPLIED),
        (MAP.echo_guard_version, GuardStatus.APPLIED),
        (590, GuardStatus.MEMORY),
        *((number, GuardStatus.APPLIED) for number in (591, 592, 593)),
        *((number, GuardStatus.MEMORY) for number in (594, 595, 596)),
    ],
)
def test_every_variable_vacant(bench: GuardBench, number: int, expected: GuardStatus) -> None:
    bench.write(x=1.0, y=1.0, z=2.0)
    bench.call()
    bench.write(x=2.0, y=2.0, z=4.0)
    bench.macros.set(number, None)
    assert bench.call() is expected
    moved = 1.0 if expected is GuardStatus.APPLIED else 0.0
    assert bench.applied_um == pytest.approx({"x": 1.0 + moved, "y": 1.0 + moved, "z": 2.0 + 2.0 * moved})


BLOCK = (MAP.sequence_a, *MAP.values.values(), MAP.valid_until, MAP.enable, MAP.check, MAP.sequence_b)
TIMES = tuple(CLOCK_S + late_s for late_s in (-1.0, 0.1, 29.9, 31.0, 119.0))
FOREIGN = (
    *(-0.02, 0.02, 0.0, 1e-6, -1e-6, 0.004, 0.0041, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, -1.0, 0.5, 8.0, 17.0),
    *(1e3, 1e5, 1e6, 1e9, -1e9, 1e38, 1e-9, 99_999_999.0, *TIMES),
)
"""What somebody else may leave in a macro: small and huge, other bits, other times that would be believed."""


@pytest.mark.parametrize("enable", [7.0, 6.0])
@pytest.mark.parametrize("policy", ["keep", "zero"])
@pytest.mark.parametrize("number", BLOCK)
def test_one_foreign_value_anywhere_in_the_block_and_nothing_of_it_is_applied(
    number: int, policy: str, enable: float
) -> None:
    said = Counter[GuardStatus]()
    before, asked = {"x": 1.0, "y": 1.0, "z": 2.0}, {"x": 2.0, "y": -3.0, "z": 4.0}
    least = 1e-6 if number in MAP.values.values() else 0.1 if number == MAP.valid_until else 1.0
    for foreign in (None, *FOREIGN, "one more", "one less"):
        bench = GuardBench(own_um={"z": 50.0}, on_expiry=policy)
        bench.write(**before)
        bench.call()
        bench.write(enable=enable, **asked)
        ours = bench.macros.get(number)
        nearest = {"one more": ours + least, "one less": ours - least}
        value = nearest[foreign] if isinstance(foreign, str) else foreign
        if value == ours:
            continue
        bench.macros.set(number, value)
        shown = bench.nc.control.messages_shown
        status = bench.call()
        said[status] += 1
        if policy == "zero" and status is GuardStatus.EXPIRED:
            assert number == MAP.valid_until, "a time that has passed: the policy moves the tool, not the block"
            continue
        assert status is not GuardStatus.APPLIED, value
        assert bench.applied_um == pytest.approx(before), (value, status)
        silent = (GuardStatus.TORN, GuardStatus.DISABLED)
        assert (bench.nc.control.messages_shown > shown) is (status not in silent)
        assert (bench.message == "TOOLPOINT CHECK DIFFERS") is (status is GuardStatus.CHECK)
        if status is GuardStatus.DISABLED:
            assert number == MAP.enable and value == 0.0
    expected = GuardStatus.TORN if number in (MAP.sequence_a, MAP.sequence_b) else GuardStatus.CHECK
    assert said[expected] >= 3, said


def test_two_values_exchanged_or_shifted_against_each_other_do_not_fit_the_check(bench: GuardBench) -> None:
    for changed in ({"y": 4.0, "z": -3.0}, {"y": -2.0, "z": 3.0}):
        bench.write(x=2.0, y=-3.0, z=4.0)
        for axis, um in changed.items():
            bench.macros.set(MAP.values[axis], um / 1000.0)
        assert bench.call() is GuardStatus.CHECK
        assert bench.applied_um == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.0})


def test_the_check_stays_below_what_eight_digits_hold() -> None:
    """Nine axes at the largest bound, the last sequence number, the latest time that the clock can say."""
    axes = [f"a{place}" for place in range(9)]
    macros = MAP.model_copy(update={"values": {axis: 600 + place for place, axis in enumerate(axes)}})
    held = dict.fromkeys(macros.values.values(), 1.0)
    held |= {MAP.sequence_b: 999_999.0, MAP.enable: 511.0, MAP.valid_until: 2_147_483.6 + 120.0}
    check = block_check(macros, axes, held)
    assert check == 999_999 + 511 + 21_476_036 + 45 * 1_000_000 < 10**8


@pytest.mark.parametrize("number", [*MAP.echo_applied.values(), 590, 594, 595, 596])
def test_a_memory_that_somebody_has_written_over_moves_nothing(bench: GuardBench, number: int) -> None:
    bench.write(x=2.0, y=2.0, z=2.0)
    bench.call()
    bench.macros.set(number, -0.004)
    bench.write(x=4.0, y=4.0, z=4.0)
    assert bench.call() is GuardStatus.MEMORY
    assert bench.applied_um == pytest.approx({"x": 2.0, "y": 2.0, "z": 2.0})
    assert bench.message == "TOOLPOINT MEMORY DAMAGED"


def test_both_copies_written_over_alike_are_held_to_the_bound(bench: GuardBench) -> None:
    bench.macros.set(MAP.echo_applied["z"], -0.2)
    bench.macros.set(596, -0.2)
    bench.write(z=4.0)
    assert bench.call() is GuardStatus.MEMORY
    assert bench.applied_um["z"] == 0.0


def test_inch_mode_is_refused(bench: GuardBench) -> None:
    bench.write(z=2.0)
    bench.modal(6, 20)
    assert bench.call() is GuardStatus.INCH
    bench.modal(6, 21)
    assert bench.applied_um["z"] == 0.0
    assert bench.message == "TOOLPOINT INCH MODE"
    assert bench.call() is GuardStatus.APPLIED


def test_inch_mode_after_a_reset_in_the_middle_settles_nothing_in_inches() -> None:
    for um, after in itertools.product((8.0, 1.0), range(250)):
        fresh = GuardBench()
        fresh.write(z=um)
        if not fresh.interrupted(after):
            continue
        fresh.modal(6, 20)
        fresh.call()
        fresh.modal(6, 21)
        fresh.call()
        assert fresh.applied_um["z"] == pytest.approx(um)
        assert fresh.settled()


@pytest.mark.parametrize("group,code", [(7, 41), (7, 42), (9, 81)])
def test_cutter_compensation_and_canned_cycles_are_no_safe_point(bench: GuardBench, group: int, code: int) -> None:
    if bench.siemens and group == 9:
        pytest.skip("a SINUMERIK has no modal group of canned cycles")
    bench.write(z=2.0)
    bench.modal(group, code)
    assert bench.call() is GuardStatus.MODAL
    assert bench.applied_um["z"] == 0.0


@pytest.mark.parametrize("code", [90, 91])
def test_incremental_mode_changes_nothing_and_comes_back(bench: GuardBench, code: int) -> None:
    bench.modal(3, code)
    for um in (3.0, -4.0, -4.0):
        bench.write(x=um, z=um)
        bench.call()
        assert bench.modal(3) == code
    bench.call(later_s=600.0)
    assert bench.modal(3) == code
    assert bench.applied_um == pytest.approx({"x": -4.0, "y": 0.0, "z": -4.0})


def test_every_interleaving_of_the_daemons_writes_with_the_guards_reads() -> None:
    old, new = {"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 2.0, "y": 4.0, "z": 6.0}
    first_read = _first_read()
    waits: Counter[int] = Counter()
    bench = GuardBench()
    bench.write(**old)
    bench.call()
    held, offsets_mm = dict(bench.macros._values), list(bench.nc.control.external_mm)
    block = bench.block(**new)
    for gaps in itertools.combinations_with_replacement(range(READS + 1), READS):
        bench.macros._values.update(held)
        bench.nc.control.external_mm[:] = offsets_mm
        waiting = list(zip((first_read + gap for gap in gaps), block, strict=True))
        for count in bench.steps():
            while waiting and waiting[0][0] <= count:
                bench.macros.set(*waiting.pop(0)[1])
        waits[bench.waits] += 1
        assert bench.macros.get(MAP.echo_status) == GuardStatus.APPLIED
        found = bench.applied_um
        assert found == new or (found == old and bench.waits == 0), gaps
    assert set(waits) == {0, 1}
    assert waits[1] > 1000


def _first_read() -> int:
    """Return the number of blocks that run before the guard reads its first macro of the block."""
    bench = GuardBench()
    seen: list[int] = []
    real = bench.macros.get
    for count in bench.steps():
        bench.macros.get = lambda number, count=count: (seen.append(count) if number == 505 else None, real(number))[1]
    return seen[0]


@pytest.mark.parametrize("whole_after,status", [(1, 0), (2, 0), (3, 0), (4, 2), (99, 2)])
def test_a_block_that_is_being_written_is_read_again_for_a_while(
    bench: GuardBench, whole_after: int, status: int
) -> None:
    block = bench.block(z=6.0)
    for number, value in block[:-1]:
        bench.macros.set(number, value)
    interpreter = bench.nc.at(bench.macros, bench.clock_s)
    interpreter.start(bench.nc.programs.guard)
    waited_s = []
    while (dwell_s := interpreter.wait()) is not None:
        waited_s.append(dwell_s)
        if len(waited_s) == whole_after:
            bench.macros.set(*block[-1])
    assert bench.macros.get(MAP.echo_status) == status
    assert waited_s == [0.2] * min(whole_after, 3)
    assert bench.applied_um["z"] == pytest.approx(6.0 if status == 0 else 0.0)


def test_a_block_left_half_written_by_a_dead_daemon_expires(bench: GuardBench) -> None:
    bench.write(z=3.0)
    bench.call()
    for number, value in bench.block(z=6.0)[:3]:
        bench.macros.set(number, value)
    assert bench.call(later_s=1.0) is GuardStatus.TORN
    assert not bench.message
    assert bench.call(later_s=60.0) is GuardStatus.EXPIRED
    assert bench.message == "TOOLPOINT EXPIRED"
    assert bench.applied_um["z"] == pytest.approx(3.0)


def test_an_alarm_instead_of_a_message_ends_the_program_after_the_echo(dialect: str) -> None:
    bench = GuardBench(alarm="stop")
    bench.write(z=1.0, valid_for_s=-1.0)
    assert bench.call() is GuardStatus.EXPIRED
    assert bench.nc.control.alarm == (103, "TOOLPOINT EXPIRED")
    bench.write(z=1.0)
    bench.macros.set(MAP.check, 0.0)
    assert bench.call() is GuardStatus.CHECK
    assert bench.nc.control.alarm == ({"fanuc": 114, "sinumerik": 130}[dialect], "TOOLPOINT CHECK DIFFERS")
