"""The interpreter of SINUMERIK programs refuses what it does not know, and what only a SINUMERIK's guard does."""

import re

import pytest
from guard_bench import AXES, CLOCK_S, MAP, GuardBench

from config.schema.cnc import RequestMacrosConfig
from config.schema.guard import VACANT_R, GuardConfig
from drivers.guard.programs import guard_text
from drivers.guard.text import GuardPrograms, GuardStatus
from drivers.sim.nc.nc import MacroTable
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.sinumerik import NcError, SinumerikControl, SinumerikInterpreter, compile_archive
from drivers.sim.nc.sinumerik.control import NOT_MACHINING

GUARD = GuardConfig(dialect="sinumerik")
REQUESTED = MAP.model_copy(
    update={
        "request": RequestMacrosConfig(counter=520, kind=521, axis=522, value_mm=523, acknowledge=524),
        "safe_flag": 125,
    }
)


def ran(*lines: str, **held: float) -> MacroTable:
    """Run a program of these lines; return the R parameters."""
    macros = MacroTable()
    for name, value in held.items():
        macros.set(int(name[1:]), value)
    control = SinumerikControl(macros, addresses=["X", "Z"], increment_mm=0.001)
    archive = "\n".join(["%_N_TP1_SPF", ";$PATH=/_N_CUS_DIR", "PROC TP1", *lines, "M17"])
    SinumerikInterpreter(compile_archive(archive), control).run(1)
    return macros


# --- the interpreter ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2+3*4", 14.0),
        ("(2+3)*4", 20.0),
        ("7-2-1", 4.0),
        ("-R501+1", -1.0),
        ("TRUNC(-2.7)", -2.0),
        ("ROUND(-2.5)", -3.0),
        ("ROUND(2.4)", 2.0),
        ("ABS(R501-5)/2", 1.5),
        ("6 B_AND 3", 2.0),
        ("1/4", 0.25),
    ],
)
def test_expressions(text: str, value: float) -> None:
    assert ran(f"R500={text}", r501=2.0).get(500) == value


def test_jumps_blocks_and_definitions() -> None:
    macros = ran(
        "DEF REAL _A,_B=3",
        "DEF INT _N=0",
        "TP_AGAIN:",
        "_N=_N+1",
        "IF (_N<>4) AND (_N<10) GOTOB TP_AGAIN",
        "IF _N==4",
        "IF _B==2",
        "R500=1",
        "ENDIF",
        "R501=_N+_A",
        "ENDIF",
        "GOTOF TP_END",
        "R502=1",
        "TP_END:",
    )
    assert [macros.get(number) for number in (500, 501, 502)] == [None, 4.0, None]


@pytest.mark.parametrize(
    "line",
    [
        *(
            "R500=SIN(1)",
            "X100",
            "G0 X1",
            "R500=R501 GOTOF TP",
            "IF R500 GOTOF TP_X",
            "IF 1 GOTOF TP_X",
            "GOTOF TP_NOWHERE",
        ),
        *(
            "R500=1 AND 2",
            "R500=1.5 B_AND 1",
            "IF R500==1 AND R501==2 GOTOF TP_X",
            "ENDIF",
            "R500=$P_TOOLP",
            "S=500 F=1",
            "#500=1",
        ),
        *("DEF STRING _A", "R500=1/0", "R99999=1", "_Q=1", "R500=_Q", "TP7", "R500=ROUND(3000000000)", "STOPRE X"),
        *("$SA_TEMP_COMP_ABS_VALUE[Y]=1", "$AC_TIMER[1]=-1", "R500==1", "IDS=1 DO $R500=$AA_IM[X]", "SETAL(65000)"),
        *("PROC TP1", "WHILE R500<1", "MSG(R1)", "R500=(1", "G4 X1", "M30", "CALL TP1", "R500=1)"),
    ],
)
def test_what_it_does_not_know_or_a_control_would_refuse_is_an_error_that_names_it(line: str) -> None:
    with pytest.raises(NcError) as refused:
        ran(line, "TP_X:")
    assert "line 4" in str(refused.value) or "TP_NOWHERE" in str(refused.value) or "there is no" in str(refused.value)


@pytest.mark.parametrize(
    ("archive", "words"),
    [
        ("PROC TP1", "begins with %_N_"),
        ("%_N_TP1_SPF\nR500=1", "begins with PROC"),
        ("%_N_TP1_SPF\nPROC TP2", "PROC TP1 is expected"),
        ("%_N_TP1_SPF\nPROC TP1\nIF R1==1\nM17", "no ENDIF"),
        ("%_N_TP1_SPF\nPROC TP1\nA1:\nA1:\nM17", "occurs twice"),
        ("%_N_TP1_SPF\nPROC TP1\nM17\n%_N_TP1_SPF", "occurs twice"),
        ("%_N_TP1_SPF\nPROC TP1\nGOTOB A1\nA1:\nM17", "direction of GOTOB"),
        ("%_N_TP1_SPF\nPROC TP1\nR500=1\nDEF INT _A\nM17", "at the head"),
    ],
)
def test_an_archive_that_is_none_is_refused(archive: str, words: str) -> None:
    with pytest.raises(NcError, match=words):
        compile_archive(archive)


# --- the text ----------------------------------------------------------------------------


def test_only_parameters_of_the_map_and_of_the_guard_are_written() -> None:
    text = guard_text(MAP, AXES, GUARD)
    written = {int(number) for number in re.findall(r"^R(\d+)=", text, re.MULTILINE)}
    written |= {int(number) for number in re.findall(r"DO \$R(\d+)=", text)}
    echo = {*MAP.echo_applied.values(), MAP.echo_time, MAP.echo_status, MAP.echo_guard_version}
    assert written == echo | {MAP.valid_until, 580, 581} | set(range(590, 597))


# --- what only this guard does -----------------------------------------------------------


@pytest.fixture
def bench() -> GuardBench:
    return GuardBench(own_um={"z": 20.0}, dialect="sinumerik")


def test_other_bits_of_the_compensation_type_do_not_stand_for_bit_0(bench: GuardBench) -> None:
    bench.nc.control.compensation_types["X"] = 6
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.SWITCHED_OFF
    bench.nc.control.compensation_types["X"] = 7
    assert bench.call() is GuardStatus.APPLIED


@pytest.mark.parametrize("name", ["compensation_types", "velocity_factors"])
def test_a_control_that_does_not_act_on_the_setting_data_is_noticed(bench: GuardBench, name: str) -> None:
    getattr(bench.nc.control, name)["Y"] = 0
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.SWITCHED_OFF
    assert bench.applied_um == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert bench.message == "TOOLPOINT MD32750 OR MD32760 OFF"
    bench.write(z=5.0, enable=0.0)
    assert bench.call() is GuardStatus.DISABLED


@pytest.mark.parametrize("after_s", [0.0, 5.0, 1e5])
def test_a_block_of_before_power_off_never_counts_though_its_parameters_survive(
    bench: GuardBench, after_s: float
) -> None:
    """Early after the first power-on, when the times of both runs would look alike."""
    bench.nc.control.start_timer(1, 1.0)
    bench.clock_s = 1.0
    bench.write(z=5.0, valid_for_s=100.0)
    bench.clock_s = CLOCK_S
    assert bench.call() is GuardStatus.APPLIED
    bench.macros.set(MAP.values["z"], 0.005)
    count = bench.macros.get(581)
    bench.nc.power_cycle()
    bench.clock_s = after_s
    assert bench.macros.get(MAP.valid_until) == 101.0, "an R parameter survives"
    assert bench.call() is GuardStatus.EXPIRED
    assert bench.macros.get(MAP.valid_until) is None and bench.macros.get(581) == count + 1
    assert bench.applied_um["z"] == pytest.approx(5.0)
    assert bench.call() is GuardStatus.EXPIRED
    assert bench.macros.get(581) == count + 1, "counted once"


def test_the_clock_is_shown_all_the_time_and_stands_still_until_the_guard_has_started_it(bench: GuardBench) -> None:
    for later_s in (1.0, 2.5):
        bench.nc.show(bench.macros, CLOCK_S + later_s)
        assert bench.macros.get(580) == pytest.approx(CLOCK_S + later_s)
    bench.nc.power_cycle()
    bench.nc.show(bench.macros, 50.0)
    assert bench.macros.get(580) == pytest.approx(CLOCK_S + 2.5)
    bench.nc.at(bench.macros, 60.0).run(bench.nc.programs.start)
    bench.nc.show(bench.macros, 61.0)
    assert bench.macros.get(580) == pytest.approx(1.001)


def test_a_flag_of_before_power_off_is_no_safe_point() -> None:
    nc, macros = SafePointApplication(REQUESTED, AXES, GUARD), MacroTable()
    nc.initialise(macros, 10.0)
    assert macros.get(125) == 0.0
    nc.at(macros, 11.0).run(nc.programs.enter)
    assert macros.get(125) == 1.0
    nc.power_cycle()
    nc.at(macros, 1.0).run(nc.programs.start)
    assert macros.get(125) is None
    nc.at(macros, 2.0).run(nc.programs.leave)
    assert macros.get(125) == 0.0


def test_a_value_of_a_disabled_axis_that_is_out_of_range_does_not_stop_the_program_with_an_error(
    bench: GuardBench,
) -> None:
    bench.write(z=5.0, enable=4.0)
    bench.macros.set(MAP.values["x"], 1e30)
    assert bench.call() is GuardStatus.CHECK
    bench.write(z=5.0, enable=4.0)
    bench.macros.set(MAP.values["x"], None)
    assert bench.call() is GuardStatus.APPLIED, "vacant counts as 0 in the check"


@pytest.mark.parametrize("state", NOT_MACHINING)
def test_a_guard_that_a_block_search_runs_through_moves_nothing(bench: GuardBench, state: str) -> None:
    """The tool may stand in the work, from where the program was interrupted, and the axis would be moved at once."""
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.APPLIED
    echo_time = bench.macros.get(MAP.echo_time)
    for block in ({"z": 9.0}, {"z": 9.0, "valid_for_s": -1.0}):
        bench.write(**block)
        bench.nc.control.not_machining = {state}
        bench.clock_s += 10.0
        bench.nc.at(bench.macros, bench.clock_s).run(bench.nc.programs.guard)
        assert bench.applied_um["z"] == pytest.approx(5.0) and bench.settled()
        assert bench.macros.get(MAP.echo_time) == echo_time and not bench.message
    bench.nc.control.not_machining.clear()
    bench.write(z=9.0)
    assert bench.call() is GuardStatus.APPLIED
    assert bench.applied_um["z"] == pytest.approx(9.0)


# --- requests ----------------------------------------------------------------------------


class Asked:
    """A control with the handshake, whose request program is called."""

    def __init__(self, **guard: object) -> None:
        self.macros = MacroTable()
        self.nc = SafePointApplication(REQUESTED, AXES, GuardConfig(dialect="sinumerik", **guard))
        self.nc.initialise(self.macros, 10.0)
        self.programs = GuardPrograms.of(REQUESTED, GUARD)

    def ask(self, *, answer: float | None = 1.0, **arguments: float) -> tuple[float | None, ...]:
        """Run it to its end; `answer` times the counter is the answer after the first wait."""
        interpreter = self.nc.at(self.macros, 20.0)
        interpreter.start(self.programs.request, **arguments)
        clock_s = 20.0
        while (dwell_s := interpreter.wait()) is not None:
            clock_s += dwell_s
            self.nc.at(self.macros, clock_s)
            if answer is not None:
                self.macros.set(524, answer * self.macros.get(520))
        return tuple(self.macros.get(number) for number in (521, 522, 523))


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ({"K": 1.0}, (1.0, 0.0, 0.0)),
        ({"K": 1.0, "A": 3.0}, (1.0, 3.0, 0.0)),
        ({"K": 2.0, "A": 3.0, "V": 0.012}, (2.0, 3.0, 0.012)),
        ({"K": 3.0, "V": 7.0}, (3.0, 0.0, 7.0)),
        ({"K": 3.0, "V": 0.0}, (3.0, 0.0, 0.0)),
    ],
)
def test_a_request_is_counted_and_waits_for_its_answer(arguments: dict[str, float], written: tuple[float, ...]) -> None:
    control = Asked()
    for count in (1.0, 2.0):
        assert control.ask(**arguments) == written
        assert control.macros.get(520) == count and not control.nc.control.messages


@pytest.mark.parametrize(
    "arguments",
    [
        *({}, {"K": 0.0}, {"K": 4.0}, {"K": 1.5}, {"K": 1.0, "A": 4.0}, {"K": 1.0, "A": -1.0}, {"K": 1.0, "A": 0.5}),
        *({"K": 2.0, "A": 3.0}, {"K": 2.0, "V": 0.1}, {"K": 3.0}, {"K": 3.0, "V": 1.5}, {"K": 3.0, "V": -1.0}),
        *({"K": 3.0, "V": 1e9}, {"K": 3.0, "V": VACANT_R}, {"K": 1e30}),
    ],
)
def test_a_request_that_is_none_asks_nothing(arguments: dict[str, float]) -> None:
    control = Asked()
    control.ask(**arguments)
    assert control.macros.get(520) == 0.0
    assert control.nc.control.alarm == (120, "TOOLPOINT REQUEST WRONG")


@pytest.mark.parametrize("state", NOT_MACHINING)
@pytest.mark.parametrize("arguments", [{"K": 1.0}, {"K": 1.0, "A": 3.0}, {"K": 2.0, "A": 3.0, "V": 0.012}, {"K": 3.0}])
def test_a_request_that_a_block_search_runs_through_asks_nothing(arguments: dict[str, float], state: str) -> None:
    """The work was positioned when the program first came here: a reference of now would lose what has grown since."""
    control = Asked()
    control.ask(K=1.0)
    control.nc.control.not_machining = {state}
    assert control.ask(answer=None, **arguments) == (1.0, 0.0, 0.0)
    assert control.macros.get(520) == 1.0
    assert control.nc.control.alarm is None and not control.nc.control.messages


def test_an_old_answer_and_a_foreign_counter_are_none_to_a_new_request() -> None:
    control = Asked()
    control.macros.set(524, -1.0)
    control.ask(K=1.0)
    assert control.macros.get(520) == 2.0
    for foreign in (1e30, -5.0, 999_999.0, None):
        control.macros.set(520, foreign)
        control.ask(K=1.0)
        assert control.macros.get(520) in (1.0, 2.0)
    control.nc.control.groups[13] = 1
    control.ask(K=1.0)
    assert control.nc.control.alarm == (121, "TOOLPOINT REQUEST IN INCH")


def test_setting_data_in_inches_are_left_alone_though_the_program_is_in_millimetres() -> None:
    bench = GuardBench(dialect="sinumerik")
    bench.write(z=4.0)
    assert bench.call() is GuardStatus.APPLIED
    stood = list(bench.nc.control.external_mm)
    bench.nc.control.basic_metric = False
    bench.write(z=8.0)
    assert bench.call() is GuardStatus.INCH
    assert bench.nc.control.external_mm == stood
