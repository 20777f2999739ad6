"""Sensors of every source are cleansed as those of a line: one wrong reading after a silence moves nothing."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import yaml

from config.loader import parse_yaml_model
from config.sample import sample_configuration
from config.schema import Configuration
from daemon.estimation.cleansing import Cleansing
from daemon.history.layout import MachineLayout
from drivers.clock import SystemClock
from drivers.readings import RowMaker, cycle_of
from models.quality import Quality, Reason
from models.records import Instant, MachineTemperatures, Trace

BOX = {"id": 9, "component": "Spindle unit", "label": "Nose", "address": 0, "open": [-999]}


def machine() -> Configuration:
    content = yaml.safe_load(sample_configuration())
    modbus = {"host": "box", "sensors": [BOX, {**BOX, "id": 10, "address": 1}]}
    content["temperatures"]["sources"] = [{"name": "box", "driver": "modbus", "modbus": modbus}]
    return parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")


class Fed:
    """What becomes of the box's readings, the line being silent."""

    def __init__(self) -> None:
        configuration = machine()
        (source,) = configuration.temperatures.sources or ()
        self._maker = RowMaker(source)
        self._cleansing = Cleansing(configuration, SystemClock())

    def __call__(self, at_s: float, *numbers: float) -> MachineTemperatures:
        now = Instant(monotonic_s=at_s, utc_s=at_s, real_s=at_s)
        readings = dict(zip((9, 10), numbers, strict=True))
        return self._cleansing.on_cycle(
            cycle_of(self._maker.row(readings, Trace(first_byte=now, last_byte=now)), "box")
        )


def of_box(found: MachineTemperatures) -> Sequence[float]:
    return found.degc[4:].tolist()


def test_sources_stand_behind_the_lines_in_every_record() -> None:
    configuration = machine()
    layout = MachineLayout.from_configuration(configuration)
    assert layout.sensor_ids == (1, 2, 3, 4, 9, 10)
    assert layout.lines == {"spindle": (1, 2, 3, 4), "box": (9, 10)}
    assert configuration.temperatures.labels["Nose"] == (0, 1, 4, 5)


def test_a_first_value_counts_after_three_that_agree() -> None:
    fed = Fed()
    assert [math.isfinite(of_box(fed(10.0 * i, 20.0, 20.0))[0]) for i in range(4)] == [False, False, True, True]


@pytest.mark.parametrize("wrong", [33.0, 21.5, -15.0, 99.0])
def test_one_wrong_reading_after_a_silence_moves_nothing(wrong: float) -> None:
    fed = Fed()
    for i in range(6):
        fed(10.0 * i, 20.0, 20.0)
    after = fed(200.0, wrong, 20.0)
    assert after.quality[4] != Quality.GOOD and after.degc[4] != wrong
    last = [fed(200.0 + 10.0 * i, 20.0, 20.0) for i in range(1, 5)][-1]
    assert of_box(last) == [20.0, 20.0]


def test_an_open_sensor_is_held_and_then_missing_with_its_reason() -> None:
    fed = Fed()
    for i in range(6):
        fed(10.0 * i, 20.0, 20.0)
    held = fed(60.0, -999.0, 20.0)
    assert held.quality[4] == Quality.HELD and held.degc[4] == 20.0 and held.reason[4] == Reason.DEVICE_ERROR
    gone = [fed(60.0 + 10.0 * i, -999.0, 20.0) for i in range(1, 8)][-1]
    assert np.isnan(gone.degc[4]) and gone.degc[5] == 20.0
