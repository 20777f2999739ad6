"""FOCAS2 on this computer: how long a block takes, and what fuzzed frames do to both sides.

    python tests/benchmarks/bench_focas.py [--writes 5000] [--frames 10000000] [--seed 1]

The fuzz has no sockets: answers of the simulated control reach the driver's own link, tag and parsers late, twice, in
another order, cut or with flipped bits, and requests reach the control the same way. It counts values that were taken
for a macro variable that does not hold them.
"""

import argparse
import asyncio
import contextlib
import gc
import os
import random
import selectors
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

SUPPORT = Path(__file__).resolve().parent.parent / "support"
sys.path.insert(0, str(SUPPORT))

from scripted_machine import GROUPS, ScriptedNc, cnc_config  # noqa: E402

from drivers.clock import SystemClock  # noqa: E402
from drivers.contract import Cnc, DriverError  # noqa: E402
from drivers.focas.cnc import FocasCnc, FocasLink  # noqa: E402
from drivers.focas.codec import Direction, FocasFormatError, Frame, FrameBuffer, Kind, encode_frame  # noqa: E402
from drivers.focas.requests import StateRequest, SystemInfo  # noqa: E402
from drivers.sim.wires.focas_server import FocasResponder, SimulatedFocasServer  # noqa: E402

NUMBERS = (500, 501, 502, 503, 505)
KINDS = ("right", "late", "twice", "swapped", "cut", "bits", "tail")
UNTIL_BAD = 20
"""A link lives for so many exchanges at most before it is disturbed, so that every request is met."""


class LinkFuzz(ABC):
    """A control behind a disturbed wire; each macro variable holds its number and the count of the exchange."""

    stamps = 10_000_000
    """So many exchanges are told from each other."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self.nc = ScriptedNc()
        self._past: deque[bytes] = deque(maxlen=40)
        self.frames = Counter[str]()
        self.disturb = False
        self.wrong = 0
        self.taken = 0

    @abstractmethod
    def answers(self, request: bytes) -> list[bytes | None]:
        """Return what comes back for the bytes of a request; None: the connection ends there."""

    @abstractmethod
    def linked(self, count: int) -> Cnc:
        """Return a driver on a link of its own."""

    @abstractmethod
    def spoil_requests(self, count: int) -> None:
        """Give the control requests that no client would send."""

    async def one_link(self, count: int) -> None:
        """Drive a link until it is lost."""
        cnc = self.linked(count)
        self._past.clear()  # TCP carries nothing from one connection into the next
        bad = self._random.randrange(UNTIL_BAD)
        for k in range(UNTIL_BAD + 1):
            self.disturb = k >= bad
            stamp = float((count * 100 + k) % self.stamps)
            for number in NUMBERS:
                self.nc.macros.values[number] = held(stamp, number)
            try:
                found = await cnc.read_macros(NUMBERS)
            except DriverError:
                break
            self.taken += len(found)
            self.wrong += sum(found[number] != held(stamp, number) for number in NUMBERS)
        await cnc.close()


AnyFuzz = TypeVar("AnyFuzz", bound=LinkFuzz)


class LoopTransport(asyncio.Transport):
    """Stands where the socket is: what the link sends is answered at once, disturbed as the seed says."""

    def __init__(self, fuzz: LinkFuzz, link: asyncio.Protocol) -> None:
        super().__init__()
        self._fuzz, self._link, self._ended = fuzz, link, False

    def write(self, data: Any) -> None:
        for answer in self._fuzz.answers(bytes(data)):
            if answer is None:
                self.abort()
            elif not self._ended:
                self._link.data_received(answer)

    def abort(self) -> None:
        if not self._ended:
            self._ended = True
            self._link.connection_lost(None)


MOST_EXACT = 2_000_000
"""Up to here a number with three decimals fits the 31 bits of a FOCAS2 value; a larger one comes back rounded."""


def held(stamp: float, number: int) -> float:
    """Return what a macro variable holds at an exchange: the float of its three decimals, as it comes over the wire."""
    return (stamp * 1000.0 + number) / 1000.0


class _SkippingSelector(selectors.DefaultSelector):
    """Counts the time for which a loop wants to wait, and does not wait."""

    skipped_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.skipped_s += max(timeout or 0.0, 0.0)
        return super().select(0.0 if timeout is not None else None)


class SkippingLoop(asyncio.SelectorEventLoop):
    """A loop without sockets whose time-outs pass at once: what never comes is not waited for."""

    def __init__(self) -> None:
        self._waits = _SkippingSelector()
        super().__init__(self._waits)

    def time(self) -> float:
        """Return the loop's time with what it has skipped [s]."""
        return super().time() + self._waits.skipped_s


class Fuzz(LinkFuzz):
    """A simulated FOCAS2 server."""

    stamps = MOST_EXACT

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._responder = FocasResponder(self.nc, 4120)

    def answers(self, request: bytes) -> list[bytes | None]:
        (frame,) = FrameBuffer().feed(request)
        if frame.kind == Kind.CLOSE:
            return [encode_frame(Frame(Kind.CLOSE, Direction.ANSWER))]
        answer = encode_frame(Frame(Kind.DATA, Direction.ANSWER, self._responder.answer(frame.body)), version=3)
        kind = self._random.choice(KINDS) if self.disturb else "right"
        late = self._past[self._random.randrange(len(self._past))] if self._past else answer
        self._past.append(answer)
        self.frames[kind] += 1
        if kind == "late":
            return [late]
        if kind == "twice":
            return [answer, answer]
        if kind == "swapped":
            return [late, answer]
        if kind == "cut":
            return [answer[: self._random.randrange(len(answer) - 1)]]
        if kind == "bits":
            spoiled = bytearray(answer)
            head = self._random.randrange(26)  # of frame and first block: a value carries no checksum but TCP's
            spoiled[head] ^= 1 << self._random.randrange(8)
            return [bytes(spoiled), b"\0"]
        return [answer, self._random.randbytes(self._random.randrange(1, 40))] if kind == "tail" else [answer]

    def linked(self, count: int) -> Cnc:
        cnc = FocasCnc(cnc_config(focas={"host": "x"}, timeout_s=0.05), SystemClock())
        link = FocasLink("x")
        link.connection_made(LoopTransport(self, link))
        cnc._link, cnc._state = link, StateRequest(cnc._focas, SystemInfo("", False))
        return cnc

    def spoil_requests(self, count: int) -> None:
        for _ in range(count):
            body = bytearray(self._random.randbytes(self._random.randrange(60)))
            if self._random.random() < 0.7:  # a whole block with strange content
                extra = self._random.randbytes(self._random.choice((0, 0, 0, 8, 16, 24, 7)))
                function = self._random.choice((0x15, 0x16, 0xA8, 0x18, 0x19, 0x1C, 0x1D, 0x25, 0x30, 0x93, 0xFF))
                numbers = [self._random.choice((0, 99, 500, 999, 3001, 3011, 4120, -1, 2**31 - 1)) for _ in range(4)]
                fields = [28 + len(extra), 1, self._random.choice((1, 1, 1, 2)), function]
                body = bytearray(b"\0\1" + b"".join(n.to_bytes(2, "big") for n in fields))
                body += b"".join(n.to_bytes(4, "big", signed=True) for n in [*numbers, len(extra)]) + extra
            self.frames["request"] += 1
            with contextlib.suppress(FocasFormatError):
                self._responder.answer(bytes(body))


async def exchange(state: AnyFuzz, frames: int) -> AnyFuzz:
    """Exchange so many frames; returns the state with what was counted."""
    count = 0
    while sum(state.frames.values()) < frames:
        count += 1
        await state.one_link(count)
        state.spoil_requests(10)
        state.nc.macros.written.clear()
    return state


async def fuzz(frames: int, seed: int) -> Fuzz:
    """Exchange so many frames; returns what was counted."""
    return await exchange(Fuzz(seed), frames)


async def time_blocks(cnc: Cnc, block: Sequence[int], writes: int) -> None:
    """Print how long a block takes that is written and read back."""
    await cnc.connect()
    durations_ms = np.empty(writes)
    for index in range(writes):
        started_s = time.perf_counter()
        await cnc.write_macros(GROUPS)
        await cnc.read_macros(block)
        durations_ms[index] = (time.perf_counter() - started_s) * 1e3
    p50, p99, p999 = np.quantile(durations_ms, [0.5, 0.99, 0.999])
    longest = durations_ms.max()
    print(f"block written and read back  p50 {p50:.2f}  p99 {p99:.2f}  p99.9 {p999:.2f}  max {longest:.2f} ms")
    await cnc.close()


async def bench_block(writes: int) -> None:
    """Time the blocks over FOCAS2."""
    server = SimulatedFocasServer(ScriptedNc(), cnc_config(focas={"host": "127.0.0.1"}), port=0)
    await server.start()
    config = cnc_config(focas={"host": "127.0.0.1", "port": server.port})
    await time_blocks(FocasCnc(config, SystemClock()), config.macros.block, writes)
    await server.stop()


def _without_waiting(fuzzed: Coroutine[Any, Any, LinkFuzz]) -> LinkFuzz:
    with asyncio.Runner(loop_factory=SkippingLoop) as runner:
        return runner.run(fuzzed)


def _resident_kb() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


def main(
    text: str | None,
    blocks: Callable[[int], Coroutine[Any, Any, None]],
    fuzzed: Callable[[int, int], Coroutine[Any, Any, LinkFuzz]],
    writes: int,
) -> None:
    """Run both, as the command line says."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--writes", type=int, default=writes)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.writes:
        asyncio.run(blocks(options.writes))
    _without_waiting(fuzzed(2000, options.seed))
    before_kb = _resident_kb()
    started_s = time.process_time()
    state = _without_waiting(fuzzed(options.frames, options.seed + 1))
    grown_kb = _resident_kb() - before_kb
    used_s = time.process_time() - started_s
    print(f"{sum(state.frames.values())} frames ({dict(state.frames)}) in {used_s:.0f} s of a core")
    print(f"{state.taken} values taken, {state.wrong} for the wrong macro variable; memory grew by {grown_kb:.0f} kB")


if __name__ == "__main__":
    main(__doc__, bench_block, fuzz, writes=5000)
