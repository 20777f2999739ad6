"""A control that lacks what compensation stands on is refused with its reason and a remedy."""

from pathlib import Path

import pytest
from control_rig import machine, record_for
from memory_cnc import MemoryNc

from daemon.cnc.interlocks import Interlocks
from drivers.clock import SystemClock
from drivers.contract import Capability
from models.control.state import InhibitCode


@pytest.mark.parametrize("missing", list(Capability))
def test_what_a_control_does_not_give_stops_what_stands_on_it(tmp_path: Path, missing: Capability) -> None:
    configuration, clock = machine(tmp_path), SystemClock()
    interlocks = Interlocks(configuration, clock, record_for(configuration), lambda: "")
    nc = MemoryNc(configuration, clock)
    assert interlocks.write_inhibit(nc.open()) is None
    nc.cannot = {missing: "its protocol does not carry it"}
    found = interlocks.write_inhibit(nc.open())
    if missing in (Capability.SPINDLE_SPEED, Capability.MOTOR_TEMPERATURE, Capability.AXIS_POSITION):
        assert found is None, "a measurement that is missing is NaN, and compensation goes on"
        return
    assert found is not None and found.code is InhibitCode.CONTROL
    assert f"gives no {missing.replace('_', ' ')}: its protocol does not carry it" in found.text
    wanted = "cnc.macros.safe_flag" if missing is Capability.SEQUENCE_NUMBER else "cnc.driver"
    assert wanted in found.remedy


def test_without_sequence_numbers_in_use_none_is_needed(tmp_path: Path) -> None:
    configuration, clock = machine(tmp_path, safe_sequence_numbers=[]), SystemClock()
    reference = configuration.compensation.reference.model_copy(update={"sequence_numbers": []})
    compensation = configuration.compensation.model_copy(update={"reference": reference})
    configuration = configuration.model_copy(update={"compensation": compensation})
    nc = MemoryNc(configuration, clock)
    nc.cannot = {Capability.SEQUENCE_NUMBER: "its protocol does not carry it"}
    assert Interlocks(configuration, clock, record_for(configuration), lambda: "").write_inhibit(nc.open()) is None
