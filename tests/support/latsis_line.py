"""A LATSIS line for tests: a chain of nodes, and what an assembler makes of their bytes."""

from collections.abc import Iterable, Sequence

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.latsis.cycle import CycleAssembler
from drivers.latsis.frames import crc8, sum8
from drivers.latsis.reader import ByteInbox
from drivers.latsis.values import decode_mlx90615, decode_tmp102
from models.quality import Quality, Reason
from models.records import Instant, TemperatureCycle

PERIOD_S = 10.0
BYTE_S = 10 / 9600


def instant(at_s: float) -> Instant:
    return Instant(monotonic_s=at_s, utc_s=1e9 + at_s, real_s=at_s)


class ByHand:
    """A reader whose bytes the test brings; implements `drivers.latsis.reader.LineReader`."""

    def start(self, inbox: ByteInbox) -> None:
        """Nothing to open."""

    async def stop(self) -> None:
        """Nothing to close."""


class Line:
    """A chain of nodes, its bytes on the wire, and the assembler that listens."""

    def __init__(self, count: int = 12, *, infrared: Iterable[int] = (), **settings: object) -> None:
        chain = [f"{500 + 1}-{500 + count}"]  # sensor IDs differ from the IDs on the wire
        self.config = LineConfig.model_validate({"name": "spindle", "port": "none", "chain": chain, **settings})
        infrared = {500 + position for position in infrared}
        sensors = [
            SensorConfig(id=i, component="c", device="MLX90615" if i in infrared else "TMP102")
            for i in self.config.sensor_ids
        ]
        self.assembler = CycleAssembler(self.config, sensors)
        self.offset = self.config.id_offset
        self.digits = {i + self.offset: 4 if 500 + i in infrared else 3 for i in range(1, count + 1)}
        self.codes = {i: 0x190 + i if n == 3 else 0x3A2B for i, n in self.digits.items()}
        self.ids = tuple(range(self.offset + count, self.offset, -1))
        self.at_s = 0.0

    @property
    def silent_ids(self) -> frozenset[int]:
        """IDs on the wire that are not waited for any more."""
        return self.assembler._silent

    @property
    def quarantined(self) -> bool:
        return self.assembler._watch.quarantined

    @property
    def alarm(self) -> str | None:
        return self.assembler._watch.alarm

    def frame(self, wire_id: int, code: int | None = None, status: int = 0, digits: int | None = None) -> bytes:
        code = self.codes.get(wire_id, 0x190) if code is None else code
        digits = digits or self.digits.get(wire_id, 3)
        grammar = self.config.frame_grammar
        if grammar.checksum == "none":
            return b"%0*X%0*X\r\n" % (grammar.id_digits, wire_id, digits, code)
        body = b"%03X,%0*X,%02X" % (wire_id, digits, code, status)
        check = sum8(body) if grammar.checksum == "sum8" else crc8(body)
        return b":%b*%02X\r\n" % (body, check)

    def send(self, *frames: bytes) -> list[TemperatureCycle]:
        """Send frames at 9600 baud, one byte at a time, without a pause before them."""
        cycles = []
        for byte in b"".join(frames):
            cycles += self.assembler.feed(bytes([byte]), instant(self.at_s))
            self.at_s += BYTE_S
        return cycles

    def rest(self) -> list[TemperatureCycle]:
        """Let the line be silent until its next pass is due."""
        start_s = self.at_s
        cycles = []
        while self.at_s < start_s + 0.6 * PERIOD_S:
            self.at_s += PERIOD_S / 16
            cycles += self.assembler.poll(instant(self.at_s))
        return cycles

    def one_pass(self, ids: Sequence[int] | None = None, **codes: int) -> list[TemperatureCycle]:
        """Send one whole pass (or the given IDs) and let the line rest."""
        changed = {int(name[1:]): code for name, code in codes.items()}
        frames = [self.frame(i, changed.get(i)) for i in (self.ids if ids is None else ids)]
        return self.send(*frames) + self.rest()

    def good(self, cycle: TemperatureCycle) -> dict[int, float]:
        """Accepted values by ID on the wire."""
        return {
            self.offset + 1 + i: float(value) for i, value in enumerate(cycle.degc) if cycle.quality[i] == Quality.GOOD
        }

    def reasons(self, cycle: TemperatureCycle) -> dict[int, Reason]:
        return {self.offset + 1 + i: Reason(code) for i, code in enumerate(cycle.reason) if code}

    def expected(self) -> dict[int, float]:
        return {
            i: decode_tmp102(code)[0] if self.digits[i] == 3 else decode_mlx90615(code)[0]
            for i, code in self.codes.items()
        }


def only(cycles: list[TemperatureCycle]) -> TemperatureCycle:
    assert len(cycles) == 1
    return cycles[0]
