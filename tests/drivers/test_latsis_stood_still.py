"""What waited in the port while this computer stood still: nobody knows how old it is, and none of it is of now."""

import pytest
from control_rig import HandClock
from latsis_line import PERIOD_S, ByHand

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.contract import LinkError
from drivers.latsis.source import DEAD_LINE_PERIODS, LatsisSerialSource


class Waiting:
    """A line whose bytes wait until its source is asked."""

    def __init__(self) -> None:
        line = LineConfig.model_validate({"name": "spindle", "port": "/dev/null", "chain": ["101-105"]})
        sensors = [SensorConfig(id=i, component="c") for i in line.sensor_ids]
        self.clock = HandClock()
        self.source = LatsisSerialSource(line, sensors, self.clock, reader=ByHand())
        self.cycles = self.source.cycles()

    def comes(self, code: int, after_s: float) -> None:
        """Let a pass come so long after the one before."""
        self.clock.monotonic_s += after_s
        self.source.put(b"".join(b"%02X%03X\r\n" % (i, code) for i in range(5, 0, -1)), self.clock.now())

    async def next_degc(self) -> float:
        return float((await anext(self.cycles)).degc[0])


async def test_passes_that_waited_while_the_process_was_stopped_are_given_up_with_the_line() -> None:
    line = Waiting()
    line.comes(0x190, PERIOD_S)
    assert await line.next_degc() == 25.0
    line.comes(0x191, 300.0)
    for code in range(0x192, 0x1A0):
        line.comes(code, 0.0)
    with pytest.raises(LinkError, match=r"line spindle: this computer stood still for up to 300 s.*see what stopped"):
        await anext(line.cycles)


async def test_what_was_read_in_time_counts_however_late_the_loop_takes_it() -> None:
    line = Waiting()
    line.comes(0x190, PERIOD_S)
    assert await line.next_degc() == 25.0
    for code in range(0x191, 0x1A0):
        line.comes(code, PERIOD_S)
    line.clock.monotonic_s += 300.0
    for code in range(0x191, 0x1A0):
        assert await line.next_degc() == code / 16.0
    await line.source.close()


async def test_a_line_that_comes_back_before_it_is_given_up_goes_on() -> None:
    line = Waiting()
    for number in range(4):
        line.comes(0x190, DEAD_LINE_PERIODS * PERIOD_S - 0.1 if number else PERIOD_S)
        assert await line.next_degc() == 25.0
    await line.source.close()
