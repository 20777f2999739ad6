"""Sensors of every source are cleansed as those of a line: one wrong reading after a silence moves nothing."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from config.loader import parse_yaml_model
from config.sample import sample_configuration
from config.schema import Configuration
from daemon.estimation.cleansing import Cleansing
from daemon.estimation.sensor_memory import LevelMemory
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import InOtherUnit
from drivers.clock import SystemClock
from drivers.readings import RowMaker, cycle_of
from models.quality import Quality, Reason
from models.records import Instant, MachineTemperatures, Trace
from models.sensor_levels import first_levels

BOX = {"id": 9, "component": "Spindle unit", "label": "Nose", "address": 0, "open": [-999]}
TENTHS = {"type": "float32", "resolution": 0.1}


def machine(period_s: float = 10.0, **how: Any) -> Configuration:
    content = yaml.safe_load(sample_configuration())
    modbus = {"host": "box", "sensors": [{**BOX, **how}, {**BOX, "id": 10, "address": 2, **how}]}
    source = {"name": "box", "driver": "modbus", "modbus": modbus, "cycle_period_s": period_s}
    content["temperatures"]["sources"] = [source]
    return parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")


class Fed:
    """What becomes of the box's readings, the line being silent."""

    def __init__(self, period_s: float = 10.0, **how: Any) -> None:
        configuration = machine(period_s, **how)
        (source,) = configuration.temperatures.sources or ()
        self._maker = RowMaker(source)
        self._cleansing = Cleansing(configuration, SystemClock())

    def refusal(self, at_s: float) -> str:
        """Why a reference is refused."""
        return self._cleansing.refusal(int(np.isfinite(self._cleansing.mean_degc()).sum()), at_s)

    def __call__(self, at_s: float, *numbers: float) -> MachineTemperatures:
        now = Instant(monotonic_s=at_s, utc_s=at_s, real_s=at_s)
        readings = dict(zip((9, 10), numbers, strict=True))
        return self._cleansing.on_cycle(
            cycle_of(self._maker.row(readings, Trace(first_byte=now, last_byte=now)), "box")
        )


def of_box(found: MachineTemperatures) -> Sequence[float]:
    return found.degc[4:].tolist()


@pytest.mark.parametrize(
    ("how", "from_degc", "step_k", "jumped"),
    [
        (TENTHS, 20.0, 0.9, False),
        (TENTHS, 20.0, 1.0, True),
        ({"type": "float32"}, 20.3, 1.0, True),
        ({}, 20.0, 1.0, False),
        ({"type": "float32"}, 20.0, 1.0, False),
        ({"resolution": 0.5, "type": "float32"}, 20.0, 1.0, True),
        ({"resolution": 1.0, "type": "float32", "unit": "K", "offset": 273.15}, 20.0, 1.0, False),
    ],
    ids=["less", "stuck bit", "stuck bit, unknown step", "whole register", "whole degrees", "two steps", "K"],
)
def test_a_change_as_large_as_the_largest_is_a_jump_but_not_of_a_sensor_that_counts_in_such_steps(
    how: dict[str, Any], from_degc: float, step_k: float, jumped: bool
) -> None:
    """A stuck bit of 1 K lies exactly there, and a sensor comes back from it by as much; whole degrees warm by it."""
    fed = Fed(**how)
    for i in range(6):
        fed(10.0 * i, from_degc, 20.0)
    found = [fed._cleansing.jumped_k for i in range(6, 12) if fed(10.0 * i, from_degc + step_k, 20.0)]
    assert any(each is not None for each in found) == jumped


@pytest.mark.parametrize("period_s", [0.2, 5.0, 10.0])
def test_a_sensor_that_comes_off_is_doubted_however_often_it_is_read(period_s: float) -> None:
    """It goes to the air's temperature within half a minute: from one reading to the next by less than the noise."""
    fed = Fed(period_s, **TENTHS)
    for at_s in np.arange(0.0, 300.0, period_s):
        fed(at_s, 25.0, 24.0)
    for at_s in np.arange(300.0, 400.0, period_s):
        fed(at_s, round(20.0 + 5.0 * math.exp(-(at_s - 300.0) / 10.0), 1), 24.0)
    uncertain_k = fed._cleansing.levels.uncertainty_k
    assert uncertain_k[4] == pytest.approx(-4.3, abs=0.8) and uncertain_k[5] == 0.0


@pytest.mark.parametrize("period_s", [0.2, 3.0, 7.0, 10.0])
def test_a_spindle_that_warms_fast_and_a_sensor_with_noise_are_believed_however_often_they_are_read(
    period_s: float,
) -> None:
    fed, rng = Fed(period_s, **TENTHS), np.random.default_rng(4)
    for at_s in np.arange(0.0, 400.0, period_s):
        warm_degc = float(np.interp(at_s, [100.0, 280.0], [20.0, 33.0]))
        fed(at_s, round(warm_degc, 1), round(25.0 + rng.normal(0.0, 0.15), 1))
        assert at_s < 60.0 or fed.refusal(at_s) == "", "a reference is set meanwhile"
    assert not fed._cleansing.levels.uncertainty_k.any() and fed._cleansing.levels.jumps == ()


@pytest.mark.parametrize("period_s", [1.0, 5.0, 10.0])
def test_what_a_machine_did_while_nothing_at_all_was_read_is_doubted_however_often_it_is_read(period_s: float) -> None:
    """It has cooled by 8 K in two hours, or the box is wrong by that: nobody is there who could tell."""
    fed = Fed(period_s, **TENTHS)
    last_s = 605.0 - 605.0 % period_s
    for at_s in np.arange(0.0, last_s + period_s / 2, period_s):
        fed(float(at_s), 30.0, 31.0)
    for at_s in last_s + 7200.0 + period_s * np.arange(12):
        fed(float(at_s), 22.0, 23.0)
    assert np.abs(fed._cleansing.levels.uncertainty_k[4:]).min() > 7.0


@pytest.mark.parametrize("wrong", [33.0, 21.5, -15.0, 99.0])
def test_one_wrong_reading_after_a_silence_moves_nothing(wrong: float) -> None:
    fed = Fed()
    for i in range(6):
        fed(10.0 * i, 20.0, 20.0)
    after = fed(200.0, wrong, 20.0)
    assert after.quality[4] != Quality.GOOD and after.degc[4] != wrong
    last = [fed(200.0 + 10.0 * i, 20.0, 20.0) for i in range(1, 5)][-1]
    assert of_box(last) == [20.0, 20.0]


@pytest.mark.parametrize("silent_s", [10.0, 600.0])
def test_a_box_that_is_switched_to_degf_counts_for_nothing_and_refuses_the_reference(silent_s: float) -> None:
    fed, last_s = Fed(), 0.0
    for i in range(12):
        last_s = 10.0 * i
        fed(last_s, 20.0, 24.0)
    for i in range(40):
        last_s += silent_s if i == 0 else 10.0
        found = fed(last_s, 68.0 + 0.1 * i, 75.2 + 0.1 * i)
        assert (found.quality[4:] != Quality.GOOD).all() and (found.reason[4:] == Reason.OTHER_UNIT).all()
        why = fed.refusal(last_s)
        assert "box" in why and "degF" in why and "set its unit back" in why
    for _ in range(20):
        last_s += 10.0
        found = fed(last_s, 22.2, 26.2)
    assert of_box(found) == [22.2, 26.2] and fed.refusal(last_s) == ""


async def test_that_a_box_says_another_unit_outlives_a_restart(tmp_path: Path) -> None:
    configuration = machine()
    layout = MachineLayout.from_configuration(configuration)
    found = InOtherUnit(units={"box": "degF"}, degc={9: 20.0, 10: 24.0})
    for kept in (found, None):
        history = HistoryWriter(tmp_path / "h.sqlite", clock=SystemClock(), machine=layout)
        memory = LevelMemory(history, configuration.temperatures.reads, SystemClock())
        history.start()
        if kept is not None:
            memory.keep(first_levels(len(layout.sensor_ids)), {}, kept)
        await history.flushed()
        history.close()
    fed = Fed()
    fed._cleansing.units.recall(memory.units)
    assert [fed(10.0 * i, 80.0, 84.0).quality[4] == Quality.GOOD for i in range(12)] == [False] * 12
    assert "degF" in fed.refusal(120.0)
    assert of_box([fed(130.0 + 10.0 * i, 27.0, 29.0) for i in range(4)][-1]) == [27.0, 29.0] and not fed.refusal(160.0)


@pytest.mark.parametrize("set_right", [False, True])
def test_a_box_that_was_switched_while_the_daemon_was_away_is_found_unless_the_configuration_was_set_right(
    set_right: bool,
) -> None:
    fed = Fed()
    past = np.array([np.nan] * 4 + ([np.nan] * 2 if set_right else [20.0, 24.0]))
    fed._cleansing.recall(past, np.where(np.isnan(past), -np.inf, -30.0))
    last = [fed(10.0 * i, 68.0, 75.2) for i in range(12)][-1]
    assert (last.quality[4] == Quality.GOOD) == set_right
    assert ("degF" in fed.refusal(120.0)) != set_right
