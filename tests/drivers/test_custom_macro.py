"""The custom-macro interpreter: vacant variables, expressions, jumps, calls, and errors for everything else."""

import pytest

from drivers.sim.nc.custom_macro import Interpreter, MacroControl, NcError, compile_programs
from drivers.sim.nc.nc import MacroTable


def control() -> MacroControl:
    return MacroControl(MacroTable(), addresses="XYZ", increment_mm=0.001)


def run(body: str, **arguments: float) -> MacroControl:
    """Run `body` as O1, with a sub-program O2 that writes its arguments A and Z into #600 and #601."""
    machine = control()
    text = f"%\nO1(TEST)\n{body}\nM99\nO2\n#600=#1\n#601=#26\n#1=99\nM99\n%\n"
    Interpreter(compile_programs(text), machine).run(1, **arguments)
    return machine


def value(expression: str, **arguments: float) -> float | None:
    return run(f"#500={expression}", **arguments).get(500)


@pytest.mark.parametrize(
    "expression,expected",
    [
        ("1+2*3", 7.0),
        ("[1+2]*3", 9.0),
        ("10-4-3", 3.0),
        ("-3+5", 2.0),
        ("2*-3", -6.0),
        ("-[2+3]", -5.0),
        ("8/4/2", 1.0),
        ("7MOD4", 3.0),
        (".5+1.", 1.5),
        ("FIX[2.7]", 2.0),
        ("FIX[-2.7]", -2.0),
        ("FUP[2.1]", 3.0),
        ("ROUND[2.5]", 3.0),
        ("ROUND[-2.5]", -3.0),
        ("ABS[-4.5]", 4.5),
        ("SQRT[9]", 3.0),
        ("6AND3", 2.0),
        ("6OR1", 7.0),
        ("6XOR3", 5.0),
        ("#[500+1-1]", None),
        ("#4003", 90.0),
        ("#4006", 21.0),
        ("#5203", 0.0),
        ("#3001", 0.0),
    ],
)
def test_expressions(expression: str, expected: float | None) -> None:
    assert value(expression) == expected


@pytest.mark.parametrize(
    "expression,expected",
    [("#0", None), ("#1", None), ("#1+0", 0.0), ("#1*5", 0.0), ("1-#1", 1.0), ("-#1", 0.0), ("ABS[#1]", 0.0)],
)
def test_vacant_is_zero_in_arithmetic_and_stays_vacant_alone(expression: str, expected: float | None) -> None:
    assert value(expression) == expected


@pytest.mark.parametrize(
    "condition,vacant,zero",
    [
        ("#1EQ#0", True, False),
        ("#1NE#0", False, True),
        ("#1EQ0", False, True),
        ("#1NE0", True, False),
        ("#1GE#0", True, True),
        ("#1GT0", False, False),
        ("#1LE#0", True, True),
        ("#1LT0", False, False),
        ("#1GE0", True, True),
    ],
)
def test_comparisons_with_vacant(condition: str, vacant: bool, zero: bool) -> None:
    body = f"IF[{condition}]THEN#500=1"
    assert (run(body).get(500) == 1.0) is vacant
    assert (run(body, A=0.0).get(500) == 1.0) is zero


def test_arguments_reach_local_variables_and_levels_keep_theirs() -> None:
    machine = run("#1=5\nG65P2A7.Z-1.5\n#500=#1")
    assert [machine.get(number) for number in (500, 600, 601)] == [5.0, 7.0, -1.5]
    machine = run("G65P2A#9\n#500=1")
    assert machine.get(600) is None


def test_jumps_and_loops() -> None:
    body = "#1=0\nWHILE[#1LT5]DO1\n#2=0\nWHILE[#2LT2]DO2\n#2=#2+1\n#500=#500+1\nEND2\n#1=#1+1\nEND1\n#501=#1"
    machine = run(body)
    assert (machine.get(500), machine.get(501)) == (10.0, 5.0)
    machine = run("#9=20\nGOTO#9\nN10#500=1\nGOTO30\nN20#500=2\nIF[#500EQ2]GOTO30\n#500=3\nN30")
    assert machine.get(500) == 2.0


def test_external_offset_absolute_incremental_and_in_inches() -> None:
    machine = run("G90G10L2P0X1.5Y-0.25\nG91G10L2P0X0.0014\n#500=#5201\nG20\n#501=#5202\n#502=#4006\n#503=#4003")
    assert machine.external_mm == pytest.approx([1.501, -0.25, 0.0])
    assert machine.get(500) == pytest.approx(1.501)
    assert machine.get(501) == pytest.approx(-0.25 / 25.4)
    assert (machine.get(502), machine.get(503)) == (20.0, 91.0)


def test_alarm_ends_the_program_and_message_does_not() -> None:
    machine = run("#3006=1(LOOK HERE)\n#500=1\n#3000=12(ENOUGH)\n#500=2")
    assert (machine.alarm, list(machine.messages), machine.get(500)) == ((12, "ENOUGH"), ["LOOK HERE"], 1.0)


def test_a_reset_can_come_between_any_two_blocks() -> None:
    machine = control()
    interpreter = Interpreter(compile_programs("O1\n#1=1\n#500=1\nG65P2\n#500=3\nM99\nO2\n#500=2\nM99"), machine)
    seen = []
    for blocks in range(8):
        machine.set(500, None)
        interpreter.start(1)
        for _ in range(blocks):
            if interpreter.running:
                interpreter.step()
        seen.append(machine.get(500))
        interpreter.reset()
        assert not interpreter.running
    assert seen == [None, None, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0]


@pytest.mark.parametrize(
    "body,problem",
    [
        ("#1=1/0", "division by zero"),
        ("#1=SQRT[-1]", "SQRT of -1"),
        ("#0=1", "#0 cannot be written"),
        ("#1=#50", "#50 cannot be read"),
        ("#1=#2001", "#2001 cannot be read"),
        ("#5201=1", "#5201 cannot be written"),
        ("#1=#1.5", "whole number"),
        ("#[0.5]=1", "no whole number"),
        ("G01X1.", "G1 is not known"),
        ("G28Z0", "G28 is not known"),
        ("M03S1000", "is not known"),
        ("X1.Y2.", "is not known"),
        ("G10L2P1X1.", "only L2 P0"),
        ("G10L2P0A1.", "the axes X Y Z, not A"),
        ("G53X1.", "stands alone"),
        ("G53G10L2P0X1.", "do not go together"),
        ("G04F2.", "G04 takes"),
        ("G65P77", "no program O77"),
        ("G65P2A1", "decimal point"),
        ("G65P2N5.", "no argument N"),
        ("#1=777\nGOTO#1", "no N777"),
        ("#1=2#2=3", "not expected"),
        ("IF[#1EQ1]#2=1", "GOTO or THEN"),
        ("IF[#1]GOTO1", "a comparison"),
        ("#1=[1+2", "is expected"),
        ("#1=", "an expression is expected"),
        ("#1=SIN[30]", "instead of"),
        ("g90", "'g'"),
        ("#1=1;", "';'"),
        ("GOTO5", "no N5"),
        ("N1\nN1", "occurs twice"),
        ("WHILE[#1LT1]DO1\n#1=1", "has no END"),
        ("END1", "closes no loop"),
        ("WHILE[#1LT1]DO4", "numbered 1 to 3"),
        ("/M99", "'/'"),
        ("WHILE[1EQ1]DO1\nEND1", "no end after"),
    ],
)
def test_everything_else_is_refused_with_its_line(body: str, problem: str) -> None:
    with pytest.raises(NcError, match=r"line \d+|O1") as refused:
        run(body)
    assert problem in str(refused.value)
    if "occurs" not in problem and "no END" not in problem and "no end" not in problem:
        assert body.splitlines()[-1] in str(refused.value)
