"""A Haas control's machine data collection on this computer: how long a block takes, and what fuzzed lines do.

    python tests/benchmarks/bench_haas.py [--writes 1000] [--frames 10000000] [--seed 1]

The fuzz has no sockets: answers of the simulated control reach the driver's own link and parsers late, twice, mixed
with those of another client, cut or with flipped bits, and requests reach the control the same way. It counts values
that were taken for a macro variable that does not hold them.
"""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent.parent / "support")]

from bench_focas import NUMBERS, LinkFuzz, LoopTransport, exchange, main, time_blocks  # noqa: E402
from scripted_machine import ScriptedNc, cnc_config  # noqa: E402

from drivers.clock import SystemClock  # noqa: E402
from drivers.contract import Cnc  # noqa: E402
from drivers.haas.cnc import HaasCnc, HaasLink  # noqa: E402
from drivers.haas.codec import HaasFormatError, LineBuffer  # noqa: E402
from drivers.sim.wires.haas_server import HaasResponder, SimulatedHaasServer  # noqa: E402

KINDS = ("right", "late", "twice", "foreign", "cut", "bits", "tail")
HEAD = 12
"""Bits are flipped in the label and the number: a value carries no checksum but TCP's."""


class Fuzz(LinkFuzz):
    """A simulated MDC server."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.responder = HaasResponder(self.nc, cnc_config(haas={"host": "x"}).haas)  # type: ignore[arg-type]

    def answers(self, request: bytes) -> list[bytes | None]:
        (line,) = LineBuffer().feed(request)
        answer = self.responder.answer(line)
        kind = self._random.choice(KINDS) if self.disturb else "right"
        late = self._random.choice(self._past) if self._past else answer
        self._past.append(answer)
        self.frames[kind] += 1
        if kind == "late":
            return [late, answer]
        if kind == "twice":
            return [answer, answer]
        if kind == "foreign":
            foreign = self.responder.answer(f"?Q600 {self._random.choice((*NUMBERS, 3001, 3027, 999))}")
            return [foreign, answer] if self._random.random() < 0.5 else [answer, foreign]
        if kind == "cut":
            return [answer[: self._random.randrange(len(answer) - 1)], None]
        if kind == "bits":
            spoiled = bytearray(answer)
            spoiled[self._random.randrange(HEAD)] ^= 1 << self._random.randrange(8)
            return [bytes(spoiled), None]
        return [answer, self._random.randbytes(self._random.randrange(1, 40))] if kind == "tail" else [answer]

    def linked(self, count: int) -> Cnc:
        self.responder.numbered = bool(count % 3)
        cnc = HaasCnc(cnc_config(haas={"host": "x"}, timeout_s=0.05), SystemClock())
        link = HaasLink("x")
        link.connection_made(LoopTransport(self, link))
        cnc._link = link
        return cnc

    def spoil_requests(self, count: int) -> None:
        for _ in range(count):
            data = bytearray(self._random.randbytes(self._random.randrange(30)))
            if self._random.random() < 0.7:
                number = self._random.choice((0, 99, 500, 999, 3001, 3011, 99999, 10**9))
                value = self._random.choice(("", " 1.5", " nan", " 1e300", " -", " " + "9" * 40))
                data = bytearray(f"{self._random.choice(('?Q600 ', '?E', '?E ', '?Q'))}{number}{value}".encode())
                data[self._random.randrange(len(data))] ^= self._random.choice((0, 0, 0, 1, 32))
            self.frames["request"] += 1
            try:
                for line in LineBuffer().feed(bytes(data) + b"\r\n"):
                    self.responder.answer(line)
            except HaasFormatError:
                continue


async def fuzz(frames: int, seed: int) -> Fuzz:
    """Exchange so many lines; returns what was counted."""
    return await exchange(Fuzz(seed), frames)


async def bench_block(writes: int) -> None:
    """Time the blocks over MDC."""
    server = SimulatedHaasServer(ScriptedNc(), cnc_config(haas={"host": "127.0.0.1"}), port=0)
    await server.start()
    config = cnc_config(haas={"host": "127.0.0.1", "port": server.port})
    await time_blocks(HaasCnc(config, SystemClock()), config.macros.block, writes)
    await server.stop()


if __name__ == "__main__":
    main(__doc__, bench_block, fuzz, writes=1000)
