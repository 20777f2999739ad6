"""The sensor between two packs: its script, its lag in closed form, and what is told of it."""

import math

import numpy as np
import pytest
import yaml
from shipped_machine import shipped_machine

from drivers.clock import ScaledClock
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.machine.packs import PackedMachine, PackScript, PackScriptError, SensorOnPacks, load_pack_script
from drivers.sim.nc.program import standing_program
from drivers.sim.nc.safe_point import SafePointApplication

SCRIPT = PackScript(
    sensor=5, ice_degc=2.0, hot_degc=42.0, lag_s=40.0, change_degc=0.1875, moves_s=(100.0, 400.0), macro=549
)


def test_the_sensor_follows_its_pack_with_one_time_constant():
    sensor = SensorOnPacks(SCRIPT)
    assert sensor.degc(99.9) == 2.0
    assert sensor.degc(140.0) == pytest.approx(42.0 - 40.0 / math.e)
    top = sensor.degc(400.0)
    assert top == pytest.approx(42.0, abs=0.05)
    assert sensor.degc(440.0) == pytest.approx(2.0 + (top - 2.0) / math.e)


def packed(told):
    configuration = shipped_machine()
    machine = CfrpMachine(
        Day.draw(1, start="cold"),
        standing_program(),
        configuration.temperatures.sensors,
        SafePointApplication(configuration.cnc.macros, configuration.compensation.axes),
    )
    line = next(line for line in configuration.temperatures.lines if SCRIPT.sensor in line.sensor_ids)
    clock = ScaledClock(epoch_real_s=0.0, epoch_utc_s=0.0, speed=1.0)
    return PackedMachine(machine, SCRIPT, line.name, clock, told.append), configuration, line


def test_only_the_moved_sensor_differs_and_what_happened_is_told():
    told = []
    machine, _, line = packed(told)
    machine.began(-3.0)
    ids = line.sensor_ids
    others = [i for i, sensor_id in enumerate(ids) if sensor_id != SCRIPT.sensor]
    at = ids.index(SCRIPT.sensor)

    machine.advance(102.0)
    assert told == []
    before = machine.register_codes(ids)
    assert before[at] / 16 == pytest.approx(2.0, abs=0.2)
    assert np.all(np.array(before)[others] / 16 > 10.0)

    machine.advance(203.0)
    assert [event["move"]["number"] for event in told] == [1]
    assert told[0]["move"]["time_s"] == 100.0 and told[0]["move"]["hot"]
    assert machine.register_codes(ids)[at] / 16 == pytest.approx(SensorOnPacks(SCRIPT).degc(200.0), abs=0.2)

    machine.nc.macros.set(SCRIPT.macro, 12.5)
    machine.nc.macros.set(548, 1.0)
    assert machine.nc.macros.get(SCRIPT.macro) == 12.5
    assert [event["macro"]["value"] for event in told if "macro" in event] == [12.5]


@pytest.mark.parametrize(
    "change,sentence",
    [
        ({"moves_s": [5.0, 5.0]}, "must increase"),
        ({"moves_s": 5.0}, "a list"),
        ({"lag_s": 0.0}, "positive"),
        ({"hot_degc": "warm"}, "finite number"),
        ({"colour": 1.0}, "exactly the keys"),
    ],
)
def test_a_script_that_cannot_be_played_is_refused_in_a_sentence(tmp_path, change, sentence):
    path = tmp_path / "packs.yaml"
    content = {name: getattr(SCRIPT, name) for name in PackScript.__slots__} | {"moves_s": [1.0, 2.0]}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    assert load_pack_script(path).moves_s == (1.0, 2.0)
    path.write_text(yaml.safe_dump(content | change), encoding="utf-8")
    with pytest.raises(PackScriptError, match=sentence):
        load_pack_script(path)
