"""Modbus: how registers are grouped and read, and that no answer ever lands on another register."""

import asyncio
import json
import math
import termios
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from bad_modbus_wire import PATIENCE_S, BadWire, contents, follow, sensor, source_of, undamaged
from hypothesis import given
from hypothesis import strategies as st
from modbus_pty import ModbusPtyBox
from pydantic import ValidationError

from config.schema.modbus import ModbusConfig, ModbusSensorConfig, grouped, told_apart
from config.schema.source_drivers import SourceConfig
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.modbus.registers import number_of
from drivers.modbus.source import ModbusSource
from drivers.sim.wires.modbus_box import ModbusTcpBox, Send, registers_of
from models.quality import Reason

TYPES = ("int16", "uint16", "int32", "uint32", "float32")


def section(*sensors: dict[str, Any], **about: Any) -> ModbusConfig:
    return ModbusConfig.model_validate({"host": "box", **about, "sensors": list(sensors)})


def reads(config: ModbusConfig) -> list[tuple[int, str, int, int]]:
    return [(r.unit_id, r.table, r.start, r.count) for r in config.requests]


def test_successive_registers_are_one_request_and_the_longest_answer_bounds_it() -> None:
    eight = section(*(sensor(i) for i in range(8)))
    assert reads(eight) == [(1, "holding", 0, 8)]
    assert reads(section(sensor(0), sensor(1, type="float32"), sensor(3))) == [(1, "holding", 0, 4)]
    assert [r[3] for r in reads(section(*(sensor(i) for i in range(130))))] == [125, 5]
    assert [r[3] for r in reads(section(*(sensor(i) for i in range(8)), most_registers=3))] == [3, 3, 2]
    assert reads(section(sensor(0), sensor(4))) == [(1, "holding", 0, 1), (1, "holding", 4, 1)]
    assert reads(section(sensor(0), sensor(4), gap=3)) == [(1, "holding", 0, 5)]
    assert reads(section(sensor(0), sensor(1, table="input"), sensor(2, unit_id=7))) == [
        (1, "holding", 0, 1),
        (1, "input", 1, 1),
        (7, "holding", 2, 1),
    ]


@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=40, unique=True).map(sorted),
    st.integers(0, 20),
    st.integers(2, 125),
)
def test_every_register_is_read_whole_once_and_no_request_is_too_long(at: list[int], gap: int, most: int) -> None:
    spans = [(2 * a, 2 * a + 2) for a in at]
    groups = grouped(spans, gap, most)
    assert [span for group in groups for span in group] == spans
    parts = told_apart(groups, gap, most)
    assert all(0 < after - first <= most or after - first == 2 for first, after in parts)
    for first, after in spans:
        assert any(start <= first and after <= end for start, end in parts)


@pytest.mark.parametrize(
    ("about", "key", "sentence"),
    [
        ({"serial_port": "/dev/ttyUSB0"}, "host", "either `host`"),
        ({"host": None}, "host", "either `host`"),
        ({"host": None, "serial_port": "x", "framing": "rtu"}, "framing", "always has Modbus RTU"),
        ({"sensors": [sensor(0), {**sensor(0), "id": 2}]}, "address", "register 0 of unit 1 belongs to sensor 1000"),
        ({"sensors": [sensor(0, type="int32"), sensor(1)]}, "address", "register 1 of unit 1 belongs to"),
        ({"sensors": [sensor(65535, type="int32")]}, "address", "takes two registers"),
        ({"sensors": [sensor(0, scale=0)]}, "scale", "must not be 0"),
        ({"sensors": [sensor(0, min_degc=5.0, max_degc=5.0)]}, "min_degc", "must be below"),
    ],
)
def test_what_cannot_work_is_refused(about: dict[str, Any], key: str, sentence: str) -> None:
    with pytest.raises(ValidationError) as refused:
        ModbusConfig.model_validate({"host": "box", "sensors": [sensor(0)], **about})
    assert sentence in str(refused.value), refused.value


@given(st.sampled_from(TYPES), st.sampled_from(["big", "little"]), st.data())
def test_a_number_comes_back_from_its_registers(kind: str, order: str, data: st.DataObject) -> None:
    about = ModbusSensorConfig.model_validate(sensor(0, type=kind, word_order=order))
    bits = 8 * 2 * about.width
    if kind == "float32":
        number = data.draw(st.floats(width=32, allow_nan=False))
    elif kind.startswith("u"):
        number = float(data.draw(st.integers(0, 2**bits - 1)))
    else:
        number = float(data.draw(st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)))
    assert number_of(registers_of(number, about), about) == number


@pytest.mark.parametrize(
    ("kind", "order", "registers", "number"),
    [
        ("int16", "big", [0xFC19], -999.0),
        ("uint16", "big", [0xFC19], 64537.0),
        ("int32", "big", [0xFFFF, 0xFC19], -999.0),
        ("int32", "little", [0xFC19, 0xFFFF], -999.0),
        ("uint32", "big", [1, 0], 65536.0),
        ("float32", "big", [0x41BC, 0x0000], 23.5),
        ("float32", "little", [0x0000, 0x41BC], 23.5),
    ],
)
def test_registers_as_boxes_send_them(kind: str, order: str, registers: list[int], number: float) -> None:
    about = ModbusSensorConfig.model_validate(sensor(0, type=kind, word_order=order, open=[-999, 64537]))
    assert number_of(registers, about) == number
    assert about.is_open(number) == (number != 23.5 and number != 65536.0)


# --- no answer ever lands on another register ---------------------------------------


@pytest.mark.wires
@pytest.mark.parametrize("rtu", [False, True], ids=["tcp", "rtu-over-tcp"])
async def test_no_value_lands_on_another_register_over_tcp(rtu: bool) -> None:
    wire = BadWire(7)
    # A flipped bit in MBAP has no check of its own: TCP has one, so nothing is damaged there.
    box = ModbusTcpBox(contents, rtu=rtu, way=wire if rtu else undamaged(wire))
    await box.start()
    place = {"host": "127.0.0.1", "port": box.port, **({"framing": "rtu"} if rtu else {})}
    values, wrong = await follow(source_of(place), lambda: wire.disturbed > 150)
    await box.stop()
    assert values > 100
    assert wrong == 0


@pytest.mark.wires
async def test_no_value_lands_on_another_register_on_a_serial_line(tmp_path: Path) -> None:
    wire = BadWire(11)
    box = ModbusPtyBox(contents, tmp_path / "bus.tty", way=wire)
    box.start()
    values, wrong = await follow(source_of({"serial_port": str(tmp_path / "bus.tty")}), lambda: wire.disturbed > 150)
    box.stop()
    assert values > 100
    assert wrong == 0


@pytest.mark.wires
@pytest.mark.parametrize("delay_s", [0.0, 0.005])
async def test_an_adapter_that_echoes_what_is_sent_changes_nothing(tmp_path: Path, delay_s: float) -> None:
    def way(answer: bytes, send: Send) -> None:
        asyncio.get_running_loop().call_later(delay_s, send, answer) if delay_s else send(answer)

    box = ModbusPtyBox(contents, tmp_path / "bus.tty", way=way, echo=True)
    box.start()
    values, wrong = await follow(source_of({"serial_port": str(tmp_path / "bus.tty")}), lambda: box.requests > 40)
    assert values > 60 and wrong == 0
    box.way = wire = BadWire(13)
    values, wrong = await follow(source_of({"serial_port": str(tmp_path / "bus.tty")}), lambda: wire.disturbed > 60)
    box.stop()
    assert values > 20 and wrong == 0


@pytest.mark.wires
@pytest.mark.parametrize("answers", [1, 4])
async def test_a_box_that_ends_connections_is_asked_on_a_new_one(answers: int) -> None:
    """Some end every connection after an answer, many after a while without a request."""
    connections = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        for _ in range(answers):
            request = await reader.readexactly(12)
            registers = contents(request[6], "input" if request[7] == 4 else "holding", request[9], request[11]) or ()
            answer = request[6:8] + bytes([2 * len(registers)]) + b"".join(word.to_bytes(2) for word in registers)
            writer.write(request[:4] + len(answer).to_bytes(2) + answer)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    place = {"host": "127.0.0.1", "port": server.sockets[0].getsockname()[1], "timeout_s": 10.0}
    source = source_of(place)()
    async with asyncio.timeout(PATIENCE_S):
        cycles = source.cycles()
        for _ in range(3):
            cycle = await anext(cycles)
            assert cycle.complete and not cycle.faults
        await cycles.aclose()
    server.close()
    assert connections >= 3


@pytest.mark.wires
async def test_a_box_that_ends_a_connection_without_an_answer_is_lost_at_once_and_said_so() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(12)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    place = {"host": "127.0.0.1", "port": server.sockets[0].getsockname()[1], "timeout_s": 60.0}
    with pytest.raises(LinkError, match="it ended the connection: see whether it serves another client"):
        async with asyncio.timeout(PATIENCE_S):
            await anext(source_of(place)().cycles())
    server.close()


@pytest.mark.wires
async def test_a_dead_box_costs_its_own_sensors_only_and_a_refusal_is_put_in_words(tmp_path: Path) -> None:
    def some(unit: int, table: str, start: int, count: int) -> Sequence[int] | None:
        return None if table == "input" else contents(unit, table, start, count)

    def way(answer: bytes, send: Send) -> None:
        if answer[0] != 2:
            send(answer)

    box = ModbusPtyBox(some, tmp_path / "bus.tty", way=way)
    box.start()
    source = source_of({"serial_port": str(tmp_path / "bus.tty")})()
    async with asyncio.timeout(PATIENCE_S):
        cycle = await anext(source.cycles())
        while not math.isfinite(cycle.degc[:6].sum()):  # this computer may have been busy for longer than the time-out
            source = source_of({"serial_port": str(tmp_path / "bus.tty")})()
            cycle = await anext(source.cycles())
    await source.close()
    box.stop()
    assert (cycle.reason[6:10] == Reason.DEVICE_ERROR).all()
    assert (cycle.reason[10:] == Reason.NOT_RECEIVED).all()
    text = "\n".join(cycle.faults)
    assert "it has no such register: check `address`, `table` and `gap` (code 2)" in text
    assert "source bad: 5 more" in text or "unit 2" in text
    assert all(fault.count("source bad") == 1 for fault in cycle.faults), "each names its source once"
    assert not cycle.complete


@pytest.mark.wires
async def test_an_answer_that_cannot_be_decoded_is_said_to_be_that_and_no_traceback(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def shortened(answer: bytes, send: Send) -> None:
        """Half a register less, which the frame's own length says too."""
        head, length, rest = answer[:4], int.from_bytes(answer[4:6], "big"), answer[6:-1]
        send(head + (length - 1).to_bytes(2, "big") + rest)

    box = ModbusTcpBox(contents, way=shortened)
    await box.start()
    source = source_of({"host": "127.0.0.1", "port": box.port})()
    with pytest.raises(LinkError, match=r"registers 0-1: the answer cannot be read; it is dropped"):
        await anext(source.cycles())
    await source.close()
    await box.stop()
    assert caplog.records == []


@pytest.mark.wires
async def test_two_boxes_with_one_unit_id_are_no_sensor() -> None:
    """Through one gateway now the one answers and now the other, one of them 7.5 K colder."""
    answered = 0

    def either(_unit: int, _table: str, _start: int, count: int) -> Sequence[int]:
        nonlocal answered
        answered += 1
        return [200 if answered % 2 else 275] * count

    box = ModbusTcpBox(either)
    await box.start()
    entry = {
        "name": "bad",
        "driver": "modbus",
        "cycle_period_s": 0.02,
        "modbus": {"host": "127.0.0.1", "port": box.port, "sensors": [sensor(type="int16", scale=0.1)]},
    }
    source = ModbusSource(SourceConfig.model_validate_json(json.dumps(entry)), SystemClock())
    async with asyncio.timeout(PATIENCE_S):
        async for cycle in source.cycles():
            if cycle.number == 12:
                break
    await source.close()
    await box.stop()
    assert list(cycle.reason) == [Reason.DUPLICATE_ID]
    assert "goes back and forth between 20.0 and 27.5 degC" in cycle.faults[0] and "same `unit_id`" in cycle.faults[0]


@pytest.mark.wires
async def test_what_cannot_be_reached_is_named_with_what_to_check(tmp_path: Path) -> None:
    for place, words in (
        ({"host": "127.0.0.1", "port": 1}, "127.0.0.1:1 cannot be reached.*only connection"),
        ({"serial_port": str(tmp_path / "none")}, "none does not exist: plug the adapter in"),
    ):
        with pytest.raises(LinkError, match=f"source bad: .*{words}"):
            await anext(source_of(place)().cycles())


@pytest.mark.wires
async def test_a_port_that_does_not_take_its_settings_is_named_with_their_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As adapters without parity do, and any that is unplugged while it is being opened; it is no OSError."""
    box = ModbusPtyBox(contents, tmp_path / "port")
    box.start()

    def refuse(*_: Any) -> None:
        raise termios.error(22, "Invalid argument")

    monkeypatch.setattr(termios, "tcsetattr", refuse)
    words = r"source bad: port \S+ does not take its settings \(Invalid argument\): correct `baud`, `parity`"
    with pytest.raises(LinkError, match=words):
        await anext(source_of({"serial_port": str(tmp_path / "port"), "parity": "even"})().cycles())
    box.stop()
