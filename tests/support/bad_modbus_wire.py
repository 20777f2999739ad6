"""A Modbus bus whose answers come late, twice, in each other's place, damaged or never, and registers that say which
they are: a value that lands on another register is seen at once.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from config.schema.source_drivers import SourceConfig
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.modbus.source import ModbusSource
from drivers.sim.wires.modbus_box import Send

PATIENCE_S = 60.0


def sensor(address: int = 0, **about: Any) -> dict[str, Any]:
    return {"id": 1000 + address, "component": "Bed", "address": address, **about}


TIMEOUT_S = 0.03


def contents(unit: int, table: str, start: int, count: int) -> Sequence[int] | None:
    """Every register says which one it is."""
    return [unit * 4000 + (2000 if table == "input" else 0) + start + i for i in range(count)]


SENSORS = [sensor(i) for i in (0, 1, 10, 11, 50, 51)]
SENSORS += [{**sensor(i, table="input"), "id": 2000 + i} for i in (0, 1, 20, 21)]
SENSORS += [{**sensor(i, unit_id=2), "id": 3000 + i} for i in (0, 1, 2, 10, 11)]


def truth(each: dict[str, Any]) -> float:
    (word,) = contents(each.get("unit_id", 1), each.get("table", "holding"), each["address"], 1) or ()
    return 0.01 * word


class BadWire:
    """Lets answers come late, twice, in each other's place, damaged, or never."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._held: list[bytes] = []
        self.disturbed = 0

    def __call__(self, answer: bytes, send: Send) -> None:
        loop, chance = asyncio.get_running_loop(), self._random
        kind = chance.choice(["good"] * 12 + ["late", "twice", "swapped", "lost", "damaged", "stale", "zero"])
        self.disturbed += kind != "good"
        self._held = [*self._held[-20:], answer]
        if kind == "late":
            loop.call_later(chance.uniform(0.5, 6.0) * TIMEOUT_S, send, answer)
        elif kind == "swapped":  # another request's answer comes first
            send(chance.choice(self._held))
            loop.call_later(chance.uniform(0.0, TIMEOUT_S), send, answer)
        elif kind == "stale":
            loop.call_later(chance.uniform(0.0, 2.0) * TIMEOUT_S, send, chance.choice(self._held))
            send(answer)
        elif kind == "damaged":
            place = chance.randrange(len(answer))
            send(answer[:place] + bytes([answer[place] ^ 1 << chance.randrange(8)]) + answer[place + 1 :])
        elif kind == "zero":  # some gateways answer with the transaction number 0
            loop.call_later(chance.uniform(0.0, 3.0) * TIMEOUT_S, send, bytes(2) + answer[2:])
        elif kind != "lost":
            send(answer)
            if kind == "twice":
                send(answer)
                loop.call_later(chance.uniform(0.0, TIMEOUT_S), send, answer)


def source_of(place: dict[str, Any]) -> Callable[[], ModbusSource]:
    modbus = {"timeout_s": TIMEOUT_S, **place, "gap": 4, "sensors": [{**each, "scale": 0.01} for each in SENSORS]}
    content = {"name": "bad", "driver": "modbus", "cycle_period_s": 0.001, "modbus": modbus}
    config = SourceConfig.model_validate(content)
    return lambda: ModbusSource(config, SystemClock())


async def follow(
    make: Callable[[], ModbusSource], enough: Callable[[], bool], patience_s: float = PATIENCE_S
) -> tuple[int, int]:
    """Read until it is enough, building anew what was lost; return how many values came, and how many were wrong."""
    expected, values, wrong = np.array([truth(each) for each in SENSORS]), 0, 0
    async with asyncio.timeout(patience_s):
        while not enough() or not values:
            source = make()
            with contextlib.suppress(LinkError):
                async for cycle in source.cycles():
                    there = np.isfinite(cycle.degc)
                    values += int(there.sum())
                    wrong += int((np.abs(cycle.degc - expected)[there] > 1e-9).sum())
                    if enough():
                        break
            await source.close()
    return values, wrong


def undamaged(wire: BadWire) -> Callable[[bytes, Send], None]:
    def way(answer: bytes, send: Send) -> None:
        said = {*(bytes(2) + each[2:] for each in [*wire._held, answer]), *wire._held, answer}
        wire(answer, lambda data: send(data) if data in said else None)

    return way
