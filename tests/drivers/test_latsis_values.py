"""Values of LATSIS sensors: how codes become temperatures, and which codes are refused."""

import math

import numpy as np
import pytest
from latsis_line import Line, only

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.latsis.frames import Frame
from drivers.latsis.values import ChainDecoder, decode_tmp102
from models.quality import Reason


@pytest.fixture
def line() -> Line:
    """A bare line that has already delivered one good cycle."""
    line = Line()
    assert only(line.one_pass()).complete
    return line


# Decoding


@pytest.mark.parametrize(
    ("code", "extended", "degc"),
    [(0x190, False, 25.0), (0xE70, False, -25.0), (0x001, False, 0.0625), (0xFFF, False, -0.0625),
     (0x7FF, False, 127.9375), (0x800, False, -128.0), (0x0190, True, 25.0), (0x1E70, True, -25.0),
     (0x0960, True, 150.0), (0x1FFF, True, -0.0625)],
)  # fmt: skip
def test_tmp102_register(code: int, extended: bool, degc: float) -> None:
    assert decode_tmp102(code, extended_mode=extended) == (degc, Reason.NONE)


# Node resets


def test_a_reset_burst_is_refused_and_named(line: Line) -> None:
    cycle = only(line.one_pass(c9=0, c8=0, c7=0))
    assert line.reasons(cycle) == dict.fromkeys([7, 8, 9], Reason.RESET)
    assert all(math.isnan(cycle.degc[i - 1]) for i in (7, 8, 9))
    (fault,) = cycle.faults
    assert "burst of node resets, 3 sensors" in fault
    assert all(f"sensor {500 + i}" in fault for i in (7, 8, 9))
    assert line.good(only(line.one_pass())) == line.expected()


def test_zero_without_a_predecessor_is_refused() -> None:
    line = Line()
    assert line.reasons(only(line.one_pass(c5=0))) == {5: Reason.RESET}


@pytest.mark.parametrize(("before", "genuine"), [(0x020, True), (0xFE0, True), (0x021, False), (0xFDF, False)])
def test_a_sensor_near_zero_may_read_zero(line: Line, before: int, genuine: bool) -> None:
    line.one_pass(c5=before)  # 2 degC, -2 degC, and one step beyond each
    cycle = only(line.one_pass(c5=0))
    assert (line.reasons(cycle) == {}) == genuine
    assert line.reasons(only(line.one_pass(c5=0))) == ({} if genuine else {5: Reason.RESET})


# Errors that the sensor reports


def test_a_status_byte_is_a_device_error() -> None:
    line = Line(profile="checked")
    frames = [line.frame(i, status=0x04 if i == 6 else 0) for i in line.ids]
    cycle = only(line.send(*frames))
    assert line.reasons(cycle) == {6: Reason.DEVICE_ERROR}
    assert "sensor 506 (ID 006h) reports an error: code 0196h, status 04h, at byte 96" in cycle.faults[0]
    assert cycle.complete


@pytest.mark.parametrize("extended", [False, True])
def test_a_usual_pass_is_decoded_as_any_other(extended: bool) -> None:
    ids = (1, 2, 3, 4)
    sensors = [SensorConfig(id=i, component="c", device="MLX90615" if i == 2 else "TMP102") for i in ids]
    line = LineConfig(name="a", port="p", chain=list(ids), extended_mode=extended)
    for codes in ((1, 1, 2, 3), (0x7FF, 0x7FFF, 0x190, 0x123), (0x7FE, 14_650, 0x800, 0x190), (5, 0x8000, 6, 7)):
        frames = {i: Frame(i, code, 0, 0, 9) for i, code in enumerate(codes, start=1)}
        found = ChainDecoder(line, sensors).decode(frames, ())
        apart = ChainDecoder(line, sensors).decode(frames, {99})  # an ID that came twice: each is looked at by itself
        np.testing.assert_array_equal(found.degc, apart.degc)
        np.testing.assert_array_equal(found.quality, apart.quality)
        np.testing.assert_array_equal(found.reason, apart.reason)
        assert (found.missing, found.faults) == (apart.missing, apart.faults)
