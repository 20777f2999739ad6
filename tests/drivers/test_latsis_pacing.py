"""The sleeping reader of a LATSIS line, on a simulated wire whose every byte has its time."""

import pytest

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.latsis.cycle import CycleAssembler
from drivers.latsis.reader import ReadPacer
from models.records import Instant

COUNT = 130


class Wire:
    """Bytes that become readable at given times [s], and the reader's loop."""

    def __init__(self, speed: float = 1.0, baud: int = 9600) -> None:
        line = LineConfig(name="wire", port="none", baud=baud, chain=[f"1-{COUNT}"])
        self.assembler = CycleAssembler(line, [SensorConfig(id=i, component="c") for i in range(1, COUNT + 1)])
        self.pacer = ReadPacer(baud, speed)
        self.speed = speed
        self.byte_real_s = 10 / baud / speed
        self.now_s = 0.0
        self.reads = 0
        self.data = b"".join(b"%02X190\r\n" % i for i in range(COUNT, 0, -1))

    def read_pass(self, due_s: list[float]) -> float:
        """Read one pass; return how long after its last byte was due it was read."""
        taken = 0
        while taken < len(due_s):
            self.now_s = max(self.now_s, due_s[taken])
            there = sum(1 for due in due_s[taken:] if due <= self.now_s)
            now = Instant(monotonic_s=self.now_s * self.speed, utc_s=0.0, real_s=self.now_s)
            cycles = self.assembler.feed(self.data[taken : taken + there], now)
            taken += there
            self.reads += 1
            self.now_s += self.pacer.pause_real_s(there, now, self.assembler.earliest_end)
        assert [cycle.complete for cycle in cycles] == [True]
        return cycles[0].trace.last_byte.real_s - due_s[-1]

    def one_by_one(self, start_s: float) -> list[float]:
        return [start_s + i * self.byte_real_s for i in range(len(self.data))]


@pytest.mark.parametrize(("speed", "baud"), [(1.0, 9600), (1.0, 115200), (60.0, 9600)])
def test_a_trickle_is_read_rarely_and_its_last_byte_at_once(speed: float, baud: int) -> None:
    wire = Wire(speed, baud)
    for number in range(5):
        wire.reads = 0
        assert wire.read_pass(wire.one_by_one(10.0 * (number + 1) / speed)) < 1e-9
        if speed == 1 and number:
            assert wire.reads < len(wire.data) / 20


def test_a_sender_faster_than_the_baud_rate_is_never_slept_over() -> None:
    wire = Wire()
    for number in range(5):
        start_s = 10.0 * (number + 1)
        # Ten pieces, ten times as fast as the baud rate allows.
        due_s = [start_s + 0.01 * (i * 10 // len(wire.data)) for i in range(len(wire.data))]
        assert wire.read_pass(due_s) < 1e-9
