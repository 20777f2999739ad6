"""Modbus: what a cycle costs, and whether a value ever lands on another register; run by hand:

    python tests/benchmarks/bench_modbus.py [--disturbed 1000] [--frames 1000000] [--cycles 2000]

Prints the processor time of a cycle of 126 registers over loopback TCP; then how many values came over TCP, RTU over
TCP and a pseudo-terminal on which answers are late, doubled, swapped, damaged or lost, and how many of them were wrong;
then the same for frames without a wire: those of other requests, flipped in up to three bits, cut, joined, garbage
before them.
"""

import argparse
import asyncio
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from bad_modbus_wire import BadWire, contents, follow, source_of, undamaged
from modbus_pty import ModbusPtyBox

from config.schema.modbus import ModbusConfig, ModbusRequest
from config.schema.source_drivers import SourceConfig
from drivers.clock import SystemClock
from drivers.modbus.client import ModbusClient
from drivers.modbus.source import ModbusSource
from drivers.sim.wires.modbus_box import MBAP, READ, ModbusTcpBox, answer_to, crc16

LONG_S = 1e5


async def cost(cycles: int) -> None:
    box = ModbusTcpBox(contents)
    await box.start()
    sensors = [{"id": 1 + i, "component": "-", "address": i, "scale": 0.01} for i in range(126)]
    modbus = {"host": "127.0.0.1", "port": box.port, "sensors": sensors}
    config = SourceConfig.model_validate({"name": "b", "driver": "modbus", "cycle_period_s": 1e-6, "modbus": modbus})
    source, count, began_s = ModbusSource(config, SystemClock()), 0, time.process_time()
    async for _ in source.cycles():
        count += 1
        if count == cycles:
            break
    spent_s = time.process_time() - began_s
    await source.close()
    await box.stop()
    print(f"a cycle of 126 registers in two requests, the simulated box included: {1e3 * spent_s / cycles:.3f} ms")


async def on_bad_wires(disturbed: int) -> None:
    for name, rtu in (("TCP", False), ("RTU over TCP", True)):
        wire = BadWire(1)
        box = ModbusTcpBox(contents, rtu=rtu, way=wire if rtu else undamaged(wire))
        await box.start()
        place = {"host": "127.0.0.1", "port": box.port, **({"framing": "rtu"} if rtu else {})}
        values, wrong = await follow(source_of(place), lambda wire=wire: wire.disturbed > disturbed, LONG_S)
        await box.stop()
        print(f"{name}: {wire.disturbed} disturbed answers, {values} values, {wrong} on another register")
    with tempfile.TemporaryDirectory() as folder:
        wire, link = BadWire(2), Path(folder) / "bus.tty"
        pty = ModbusPtyBox(contents, link, way=wire)
        pty.start()
        values, wrong = await follow(source_of({"serial_port": str(link)}), lambda: wire.disturbed > disturbed, LONG_S)
        pty.stop()
        print(f"pseudo-terminal: {wire.disturbed} disturbed answers, {values} values, {wrong} on another register")


def answer(request: ModbusRequest, number: int, rtu: bool) -> bytes:
    function = 3 if request.table == "holding" else 4
    body = answer_to(request.unit_id, READ.pack(function, request.start, request.count), contents)
    if rtu:
        framed = bytes([request.unit_id]) + body
        return framed + crc16(framed)
    return MBAP.pack(number, 0, len(body) + 1, request.unit_id) + body


def mutated(frame: bytes, earlier: Sequence[bytes], chance: random.Random, rtu: bool) -> bytes:
    kind = chance.randrange(6)
    if kind == 0 and rtu:  # a check of 16 bit finds every fault of up to three bits
        bits = chance.sample(range(8 * len(frame)), chance.randint(1, 3))
        return (int.from_bytes(frame, "big") ^ sum(1 << bit for bit in bits)).to_bytes(len(frame), "big")
    if kind == 1:
        return frame[: chance.randrange(len(frame))]
    if kind == 2:
        return chance.choice(earlier) + frame
    if kind == 3:
        return chance.randbytes(chance.randrange(1, 12)) + frame if rtu else frame + chance.randbytes(3)
    if kind == 4 and not rtu:
        return bytes(2) + chance.choice(earlier)[2:]  # the transaction number 0
    return chance.choice(earlier)


async def without_a_wire(frames: int) -> None:
    for rtu in (False, True):
        client, requests = fuzzed(rtu)
        ctx, chance = client._client.ctx, random.Random(3)
        earlier = [answer(request, i, rtu) for i, request in enumerate(requests, start=60000)]
        taken = wrong = raised = 0
        for number in range(1, frames + 1):
            request = chance.choice(requests)
            ctx.request_dev_id = request.unit_id
            ctx.request_transaction_id = client._sent_number = 0 if rtu else number % 60000 + 1
            ctx.response_future = asyncio.get_running_loop().create_future()
            frame = answer(request, ctx.request_transaction_id, rtu)
            try:
                ctx.callback_data(mutated(frame, earlier, chance, rtu))
            except Exception:
                raised += 1  # asyncio closes the connection then
            if not ctx.response_future.done():
                continue
            found = ctx.response_future.result()
            if client._foreign(request, found) or found.isError():
                continue
            taken += 1
            wrong += list(found.registers) != list(
                contents(request.unit_id, request.table, request.start, request.count) or ()
            )
        print(
            f"{'RTU' if rtu else 'TCP'}: {frames} frames, {taken} taken, {raised} refused by the library, "
            f"{wrong} with another register's value"
        )


def fuzzed(rtu: bool) -> tuple[ModbusClient, list[ModbusRequest]]:
    config = source_of({"host": "x", **({"framing": "rtu"} if rtu else {})})()._config
    assert isinstance(config, ModbusConfig)
    return ModbusClient(config, "fuzz"), list(config.requests)


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disturbed", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--cycles", type=int, default=2000)
    given = parser.parse_args()
    if given.cycles:
        await cost(given.cycles)
    if given.disturbed:
        await on_bad_wires(given.disturbed)
    if given.frames:
        await without_a_wire(given.frames)


asyncio.run(main())
