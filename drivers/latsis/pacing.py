"""Decides when the reader of a LATSIS line should look again. No I/O, no clock.

At 9600 baud a byte comes every millisecond, and waking up for each would cost a hundred times more than
its decoding. In the middle of a pass nothing depends on a single byte, so the reader sleeps; but since
the length of a pass is known, it can be awake when the last byte comes. The sleep never reaches beyond
the moment at which the line, at its baud rate, can have delivered that byte.
"""

from models.records import Instant

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
LONGEST_PAUSE_REAL_S = 0.2
"""Bounds the delay where a pass ends earlier than expected (the tail of the chain sends nothing)."""
SHORTEST_PAUSE_REAL_S = 0.0003
"""A shorter sleep costs more than it saves."""
FINAL_BYTES = 4
"""The reader is awake for so many bytes before the last, should the operating system wake it late."""
LARGEST_PAUSE_BYTES = 1024
"""No sleep lets more bytes pile up: a quarter of the kernel's buffer of a serial port."""
BAUD_MARGIN = 0.95
"""The sender's clock may be this much too fast (an asynchronous receiver tolerates 5 %)."""
PACKET_BYTES = 64
"""Bytes that a USB adapter delivers together although they came one after another."""
PACKET_REAL_S = 0.02
"""How long a USB adapter may collect them (the latency timer of common ones is 16 ms)."""


class ReadPacer:
    """Decides, after each read, how long the reader sleeps.

    A sender that is faster than the baud rate (a simulated line, a network) cannot be predicted;
    its reader never sleeps.
    """

    def __init__(self, baud: int, speed: float) -> None:
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._speed = speed
        self._read = 0
        self._credit: float = PACKET_BYTES
        self._last_real_s: float | None = None
        self._pause_real_s = 0.0

    def pause_real_s(self, count: int, arrived: Instant, earliest_end: int) -> float:
        """Take a read of `count` bytes; return how long to sleep [s of this computer].

        `earliest_end` is the byte of the stream before which the cycle cannot be complete.
        """
        self._read += count
        if self._is_faster(count, arrived.real_s):
            self._pause_real_s = 0.0
            return 0.0
        awaited = min(earliest_end - self._read - FINAL_BYTES, LARGEST_PAUSE_BYTES)
        pause_s = min(awaited / self._bytes_per_s * BAUD_MARGIN / self._speed, LONGEST_PAUSE_REAL_S)
        self._pause_real_s = pause_s if pause_s >= SHORTEST_PAUSE_REAL_S else 0.0
        return self._pause_real_s

    def _is_faster(self, count: int, now_real_s: float) -> bool:
        """Return whether more bytes came than the line can have delivered since the last read.

        Only the sleep and one packet's time count: a reader that waits for bytes misses none.
        """
        elapsed_s = 0.0 if self._last_real_s is None else now_real_s - self._last_real_s
        self._last_real_s = now_real_s
        elapsed_s = min(elapsed_s, self._pause_real_s + PACKET_REAL_S)
        earned = elapsed_s * self._speed * self._bytes_per_s / BAUD_MARGIN
        self._credit = max(-PACKET_BYTES, min(PACKET_BYTES, self._credit + earned - count))
        return self._credit < 0
