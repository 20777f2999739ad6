"""Logger files, the kernel's sensors, programs, MQTT and OPC UA as sources: what each alone can do wrong."""

import asyncio
import gc
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest
from asyncua import ua
from hypothesis import given
from hypothesis import strategies as st
from mosquitto import mosquitto

from config.schema.source_drivers import SourceConfig
from config.schema.source_sections import KernelSensorConfig
from config.schema.sources import SourceSensorConfig
from drivers import kernel, pushing
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.displacement.logger import LoggerSource
from drivers.json_fields import readings_in
from drivers.kernel import KernelSource
from drivers.mqtt import MqttSource, fields_of, numbers_in
from drivers.opcua.tags import reading_of
from drivers.process import ProcessSource
from drivers.readings import NoReading, Row, judged
from models.quality import Quality, Reason
from models.records import Instant, TemperatureCycle

PATIENCE_S = 30.0
PERIOD_S = 10.0
SENSOR = {"id": 7, "component": "Bed"}
UNCERTAIN = ua.StatusCode(ua.UInt32(ua.StatusCodes.UncertainLastUsableValue))


def source(driver: str, section: dict[str, Any], *sensors: dict[str, Any], period_s: float = PERIOD_S) -> SourceConfig:
    content = {"name": "s", "driver": driver, "cycle_period_s": period_s, driver: {**section, "sensors": sensors}}
    return SourceConfig.model_validate_json(json.dumps(content))


async def following(cycles: AsyncIterator[TemperatureCycle]) -> TemperatureCycle:
    return await asyncio.wait_for(anext(cycles), PATIENCE_S)


# --- no number that is no temperature ------------------------------------------------

numbers = st.floats() | st.integers(-(2**33), 2**33).map(float)


@given(
    numbers,
    st.sampled_from(["degC", "degF", "K"]),
    st.floats(-1e6, 1e6, allow_nan=False).filter(lambda value: value != 0),
    st.floats(-1e6, 1e6, allow_nan=False),
    st.lists(st.floats(-1e6, 1e6, allow_nan=False), max_size=3),
)
def test_whatever_is_read_only_possible_temperatures_pass(
    number: float, unit: str, scale: float, offset: float, signs: list[float]
) -> None:
    about = {**SENSOR, "unit": unit, "scale": scale, "offset": offset, "open": signs, "min_degc": -20.0}
    sensor = SourceSensorConfig.model_validate({**about, "max_degc": 100.0})
    found = judged(sensor, number)
    if isinstance(found, NoReading):
        assert found.reason != Reason.NONE and found.why
    else:
        assert -20.0 <= found <= 100.0 and math.isfinite(number) and number not in signs


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", "b", "t"]), inner, max_size=3),
)


@given(json_values, st.sampled_from(["", "a", "a.b", "t.a.b", "."]))
def test_any_json_gives_numbers_or_a_reason(content: Any, field: str) -> None:
    for reading in readings_in(content, {7: field}).values():
        assert isinstance(reading, float) or reading.reason == Reason.UNREADABLE


# --- a logger's files -----------------------------------------------------------------


def test_85_degrees_of_a_one_wire_sensor_are_its_power_up() -> None:
    here = KernelSensorConfig.model_validate_json(
        json.dumps({**SENSOR, "path": "/sys/bus/w1/devices/28-1/temperature"})
    )
    assert isinstance(judged(here, 85000.0), NoReading)
    assert judged(here, 84937.0) == pytest.approx(84.937)
    there = {**SENSOR, "path": "/sys/class/hwmon/hwmon1/temp1_input"}
    assert judged(KernelSensorConfig.model_validate_json(json.dumps(there)), 85000.0) == pytest.approx(85.0)


def logger(path: Path, period_s: float = PERIOD_S, **file: Any) -> LoggerSource:
    section = {"file": {"path": str(path), "header": "t", "time_format": "%s", "poll_period_s": 0.01, **file}}
    return LoggerSource(source("csv", section, {**SENSOR, "column": "T7"}, period_s=period_s), SystemClock())


def row(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(text)


async def test_what_a_logger_wrote_long_ago_is_not_shown_as_the_present(tmp_path: Path) -> None:
    path, now_s = tmp_path / "log.csv", time.time()
    row(path, "t,T7\n" + "".join(f"{now_s - 1000 + i},{i / 10}\n" for i in range(900)))
    row(path, f"{now_s - 12.5},20.5\n")
    opened = logger(path)
    cycles = opened.cycles()
    cycle = await following(cycles)
    assert list(cycle.degc) == [20.5]
    assert cycle.trace.first_byte.utc_s == pytest.approx(now_s - 12.5, abs=0.5)
    assert cycle.trace.last_byte.monotonic_s - cycle.trace.first_byte.monotonic_s >= 12.4
    row(path, f"{now_s - 12.5},30.5\n{now_s - 50},31.5\n{now_s:.3f},2")  # repeated, older, and half a line
    await asyncio.sleep(0.05)
    row(path, "1.25\n")
    assert list((await following(cycles)).degc) == [21.25]
    await opened.close()


async def test_a_stamp_of_the_future_is_refused_and_says_what_to_correct(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    opened = logger(path)
    row(path, f"t,T7\n{time.time() + 3600:.3f},20.0\n")
    cycles = opened.cycles()
    waiting = asyncio.ensure_future(following(cycles))
    await asyncio.sleep(0.1)
    assert not waiting.done()
    row(path, f"{time.time():.2f},20.0\n")
    (fault,) = (await waiting).faults
    assert re.search(r"log.csv:2: .* 3(600|5\d\d) s ahead of this computer's clock: correct `time_zone`", fault), fault
    await opened.close()


@pytest.mark.parametrize(
    ("unit", "sensor", "refused"),
    [
        ("°F", {}, "log.csv:2:2: the row of units says °F where sensor 7 is read in degC: correct its unit or scale"),
        ("[°C]", {"unit": "degF"}, "the row of units says [°C] where sensor 7 is read in degF"),
        ("mm", {}, "the row of units says mm where sensor 7 is read in degC"),
        ("°F", {"unit": "degF"}, ""),
        ("°C", {"offset": -0.4}, ""),
        ("°C", {"unit": "degF", "scale": 1.8, "offset": 32.0}, ""),
        ("°F", {"scale": 1 / 1.8, "offset": -32 / 1.8}, ""),
        ("mV", {}, ""),
        ("-", {}, ""),
    ],
)
async def test_a_row_of_units_that_says_another_unit_is_not_read_over(
    tmp_path: Path, unit: str, sensor: dict[str, Any], refused: str
) -> None:
    path = tmp_path / "log.csv"
    file = {"path": str(path), "header": "t", "time_format": "%s", "poll_period_s": 0.01, "unit_row": True}
    opened = LoggerSource(source("csv", {"file": file}, {**SENSOR, "column": "T7", **sensor}), SystemClock())
    row(path, f"t,T7\ns,{unit}\n{time.time()},20.5\n")
    cycles = opened.cycles()
    if refused:
        with pytest.raises(LinkError, match=re.escape(refused)):
            await following(cycles)
    else:
        assert (await following(cycles)).faults == ()
    await opened.close()


async def test_a_new_file_is_followed_and_tokens_are_no_numbers(tmp_path: Path) -> None:
    now_s = time.time()
    row(tmp_path / "1.csv", f"t,T7\n{now_s - 26:.2f},20.0\n")
    opened = logger(tmp_path / "*.csv")
    cycles = opened.cycles()
    assert list((await following(cycles)).degc) == [20.0]
    row(tmp_path / "2.csv", f"t,T7\n{now_s - 18:.2f},+OVER\n")
    cycle = await following(cycles)
    assert list(cycle.reason) == [Reason.OVERFLOW] and np.isnan(cycle.degc).all()
    row(tmp_path / "2.csv", f"{now_s - 10:.2f},nan\n")
    cycle = await following(cycles)
    assert list(cycle.reason) == [Reason.UNREADABLE] and list(cycle.quality) == [Quality.MISSING]
    await opened.close()


# --- the kernel's sensors ---------------------------------------------------------------


def one_wire(folder: Path, name: str = "28-0316a2796fff") -> Path:
    path = folder / "w1_bus_master1" / name / "temperature"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("23125", 23125.0),
        ("-1250", -1250.0),
        ("23.5", 23.5),
        ("72 01 4b 46 7f ff 0e 10 57 : crc=57 YES\n72 01 4b 46 7f ff 0e 10 57 t=23125", 23125.0),
        ("72 01 4b 46 7f ff 0e 10 57 : crc=57 NO\n72 01 4b 46 7f ff 0e 10 57 t=23125", Reason.DEVICE_ERROR),
        ("", Reason.UNREADABLE),
        ("nan", Reason.UNREADABLE),
        ("1e400", Reason.UNREADABLE),
        ("23125 23125", Reason.UNREADABLE),
    ],
)
def test_texts_of_the_kernel(text: str, found: float | Reason) -> None:
    number = kernel.number_of(text, Path("x"))
    assert (number.reason if isinstance(number, NoReading) else number) == found


async def test_a_sensor_that_hangs_costs_itself_only_and_no_thread_joins_the_first(tmp_path: Path) -> None:
    good, hangs = one_wire(tmp_path), one_wire(tmp_path, "28-2")
    good.write_text("21500\n")
    os.mkfifo(hangs)
    (tmp_path / "w1_bus_master1" / "therm_bulk_read").write_text("0")
    config = source(
        "kernel",
        {"timeout_s": 0.1},
        {**SENSOR, "path": str(good)},
        {**SENSOR, "id": 8, "path": str(hangs)},
        period_s=0.01,
    )
    opened = KernelSource(config, SystemClock())
    cycles = opened.cycles()
    first = await following(cycles)
    assert first.degc[0] == 21.5 and first.reason[1] == Reason.NOT_RECEIVED
    assert "has not answered within 0.1 s" in first.faults[0]
    for _ in range(5):
        assert "since it was last read" in (await following(cycles)).faults[0]
    assert (tmp_path / "w1_bus_master1" / "therm_bulk_read").read_text() == "trigger\n"
    hangs.open("w").close()  # lets the reader go
    async with asyncio.timeout(PATIENCE_S):
        while kernel_threads():
            await asyncio.sleep(0.01)
    await opened.close()


def kernel_threads() -> list[str]:
    import threading

    return [thread.name for thread in threading.enumerate() if thread.name == "kernel-s" and thread.is_alive()]


# --- a program's lines -------------------------------------------------------------------


def program(code: str, **section: Any) -> ProcessSource:
    command = [sys.executable, "-I", "-S", "-u", "-c", code]
    config = source("process", {"command": command, **section}, {**SENSOR, "field": "t"}, period_s=0.05)
    return ProcessSource(config, SystemClock())


async def test_a_program_ends_with_its_source_and_so_does_what_it_started(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    opened = program(
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        f"open({str(note)!r}, 'w').write(str(child.pid))\n"
        "print('{\"t\": 20}'); time.sleep(60)"
    )
    await following(opened.cycles())
    child = int(note.read_text())
    await opened.close()
    async with asyncio.timeout(PATIENCE_S):
        while alive(child):
            await asyncio.sleep(0.01)


def alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(") ")[2][0] != "Z"


async def test_a_program_that_floods_makes_no_more_cycles_than_its_period_and_leaves_the_loop_to_others() -> None:
    opened = program("import sys\nwhile True: sys.stdout.write('{\"t\": 20}\\n' * 1000)")
    began_s = SystemClock().now().monotonic_s
    cycles = opened.cycles()
    for number in range(1, 11):
        cycle = await following(cycles)
        assert cycle.trace.last_byte.monotonic_s - began_s >= number * pushing.FEWEST_PERIODS * 0.05
    async with asyncio.timeout(PATIENCE_S):
        await asyncio.sleep(0.01)
    await opened.close()


async def test_of_lines_that_a_program_writes_at_once_the_newest_counts() -> None:
    """What it had kept, for want of a flush or for a daemon that stood still: the oldest was taken for the present."""
    opened = program(
        "import time\n"
        "for t in range(20, 60): print('{\"t\": %d}' % t)\n"
        "time.sleep(1.2)\n"
        "for t in range(20, 40): print('{\"t\": %d}' % t)\n"
        "time.sleep(60)"
    )
    cycles = opened.cycles()
    assert [(await following(cycles)).degc.tolist() for _ in range(2)] == [[59.0], [39.0]]
    await opened.close()


async def test_the_last_line_of_a_program_that_ends_counts() -> None:
    cycles = program("print('{\"t\": 20}'); print('{\"t\": 21}')").cycles()
    assert (await following(cycles)).degc.tolist() == [21.0]
    with pytest.raises(LinkError, match="ended with status 0"):
        await following(cycles)


# --- MQTT and OPC UA --------------------------------------------------------------------


@given(st.binary(max_size=200) | json_values.map(lambda value: json.dumps(value).encode()) | st.none() | st.integers())
def test_any_message_gives_numbers_or_a_reason(payload: Any) -> None:
    for field in ("", "a.b"):
        for reading in numbers_in(payload, {7: field}).values():
            assert isinstance(reading, float) or (reading.reason == Reason.UNREADABLE and reading.why)


@pytest.mark.parametrize(
    "payload", [b"21.5", b"+21.5", b"021.50", b' "21.5"', b"21.5\r\n\0", b"2.15e1", b"\xef\xbb\xbf21.5"]
)
def test_a_number_is_one_however_a_device_writes_it(payload: bytes) -> None:
    assert numbers_in(payload, {7: ""}) == {7: 21.5}
    assert numbers_in(b'{"T": %s}' % json.dumps(payload.decode("utf-8-sig").strip(' "')).encode(), {7: "T"}) == {
        7: 21.5
    }


def test_a_number_is_found_in_lists_and_under_keys_with_dots() -> None:
    """As boxes with several inputs publish theirs."""
    content = {"io": {"ai": [{"value": 21.5}, {"value": 22.5}]}, "port[1].pdin": 23.5, "t": [24.5]}
    fields = {1: "io.ai.1.value", 2: "port[1].pdin", 3: "t.0", 4: "t.1", 5: "t.-1", 6: "t", 7: "io.0"}
    found = readings_in(content, fields)
    assert [found.get(key) for key in (1, 2, 3, 4, 5, 7)] == [22.5, 23.5, 24.5, None, None, None]
    assert isinstance(found[6], NoReading) and "correct `field`" in found[6].why
    assert fields_of(json.dumps(content).encode()) == {
        "io.ai.0.value": 21.5,
        "io.ai.1.value": 22.5,
        "port[1].pdin": 23.5,
        "t.0": 24.5,
    }
    assert all(
        readings_in(content, {1: field}) == {1: n} for field, n in fields_of(json.dumps(content).encode()).items()
    )
    assert numbers_in(b"[21.5, 22.5]", {1: "1"}) == {1: 22.5}


async def test_messages_that_hold_no_number_of_a_sensor_are_told_by_the_key_to_correct(
    broker: int, tmp_path: Path
) -> None:
    """A sensor with a misspelt `field` was said to be silent, and its devices to be checked."""
    there = {**SENSOR, "id": 1, "topic": "m/1"}
    misspelt = {**SENSOR, "topic": "m/7", "field": "T"}
    async with aiomqtt.Client("127.0.0.1", broker, username="toolpoint", password="right") as device:
        for sensors, words in (
            ([there, misspelt], "source s: sensor 7 (Bed): was sent a message without 'T': correct `field`"),
            (
                [misspelt],
                r"no number .*; sensor 7 \(Bed\) was sent a message without 'T': correct `field`",
            ),
        ):
            opened = subscribed(broker, tmp_path, "right", *sensors, period_s=0.5)
            waiting = asyncio.ensure_future(following(opened.cycles()))
            while not waiting.done():
                await device.publish("m/1", "21.5")
                await device.publish("m/7", '{"t": 21.5}')
                await asyncio.sleep(0.05)
            if len(sensors) == 2:
                assert waiting.result().degc[0] == 21.5 and waiting.result().faults == (words,)
            else:
                with pytest.raises(LinkError, match=words):
                    waiting.result()
            await opened.close()


class StillClock(SystemClock):
    """A clock that a test moves."""

    at_s = 1000.0

    def now(self) -> Instant:
        return Instant(monotonic_s=self.at_s, utc_s=self.at_s, real_s=self.at_s)


def test_what_a_device_kept_while_it_was_cut_off_and_sends_at_once_is_one_cycle_with_the_newest() -> None:
    """An hour of 5 K in 360 messages within a second: taken one by one, the mean of the minute was 2.5 K off."""
    clock = StillClock()
    section = {"host": "127.0.0.1", "timeout_s": 5.0}
    opened = MqttSource(source("mqtt", section, {**SENSOR, "topic": "m/7"}), clock)
    for _ in range(3):
        opened.put(7, 20.0)
        clock.at_s += PERIOD_S
        rows = opened._due()
    assert [row.values.tolist() for row in rows] == [[20.0]]
    clock.at_s += 3600.0
    for step in range(361):
        opened.put(7, 20.0 + 5.0 * step / 360)
        assert opened._due() == []
        clock.at_s += 1.0 / 360
    clock.at_s += PERIOD_S
    assert [row.values.tolist() for row in opened._due()] == [[25.0]]
    clock.at_s += 0.9 * PERIOD_S
    for number in (25.1, 25.2):
        opened.put(7, number)
        assert [row.values.tolist() for row in opened._due()] == ([[25.1]] if number == 25.1 else [])


class Topic:
    """One topic of a source, to which messages are passed on ten seconds apart."""

    def __init__(self) -> None:
        self._clock = StillClock()
        section = {"host": "127.0.0.1", "timeout_s": 5.0}
        self._source = MqttSource(source("mqtt", section, {**SENSOR, "topic": "m/7"}), self._clock)

    def __call__(self, degc: float) -> Row:
        """Return the cycle of this message."""
        message = aiomqtt.Message("m/7", f"{degc:.3f}".encode(), qos=0, retain=False, mid=0, properties=None)
        self._source._take(message)
        self._clock.at_s += PERIOD_S
        (row,) = self._source._due()
        return row


def test_two_devices_that_publish_under_one_topic_are_no_sensor_until_one_of_them_ends() -> None:
    """A device that was forgotten says 20 degC while the place warms by 8 K: it alone counted, and nobody was told."""
    topic = Topic()
    warming = [20.0 + 8.0 * (1.0 - math.exp(-i / 40.0)) for i in range(120)]
    rows = [topic(degc) for each in warming for degc in (each, 20.0)]
    wrong = [row for row in rows if abs(row.values[0] - 20.0) < 1.0][-1]
    assert rows.index(wrong) < 40 and warming[rows.index(wrong) // 2] < 22.6
    assert [row.reason[0] for row in rows[40:]] == [Reason.DUPLICATE_ID] * 200
    assert "goes back and forth between 20.0 and 27.6 degC: end what else" in rows[-1].faults[0]
    after = [topic(warming[-1]) for _ in range(12)]
    assert after[-1].values.tolist() == [round(warming[-1], 3)] and not after[-1].faults


@pytest.mark.parametrize(
    "healthy",
    [
        [20.0 + i for i in range(40)],
        [20.0 + i % 2 for i in range(40)],
        [20.0 + 0.5 * (-1) ** i for i in range(40)],
        [33.0 if i == 20 else 20.0 for i in range(40)],
        [20.0 if i < 20 else 26.0 for i in range(40)],
    ],
    ids=["warms by 6 K/min", "whole degrees", "noise", "one wrong number", "another level"],
)
def test_one_device_counts_whatever_its_place_does(healthy: list[float]) -> None:
    topic = Topic()
    assert [topic(degc).values[0] for degc in healthy] == healthy


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    maker = shutil.which("mosquitto_passwd", path=f"{os.environ.get('PATH', '')}:/usr/bin")
    if maker is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    passwords = tmp_path / "passwords"
    subprocess.run([maker, "-b", "-c", str(passwords), "toolpoint", "right"], check=True)
    passwords.chmod(0o644)
    tmp_path.chmod(0o755)
    with mosquitto(tmp_path, "allow_anonymous false", f"password_file {passwords}") as port:
        yield port


def subscribed(port: int, folder: Path, password: str, *sensors: dict[str, Any], period_s: float = 0.05) -> MqttSource:
    secret = folder / "secret"
    secret.write_text(password + "\n")
    secret.chmod(0o600)
    section = {"host": "127.0.0.1", "port": port, "user_name": "toolpoint", "password_file": str(secret)}
    sensors = sensors or ({**SENSOR, "topic": "m/7"},)
    return MqttSource(source("mqtt", section, *sensors, period_s=period_s), SystemClock())


@pytest.mark.wires
async def test_a_broker_that_gives_nobody_a_name_is_told_one(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    with mosquitto(tmp_path, "allow_anonymous true", "allow_zero_length_clientid false") as port:
        section = {"host": "127.0.0.1", "port": port}
        opened = MqttSource(source("mqtt", section, {**SENSOR, "topic": "m/7"}, period_s=5.0), SystemClock())
        cycles = opened.cycles()
        following = asyncio.ensure_future(anext(cycles))
        async with aiomqtt.Client("127.0.0.1", port, identifier="device") as device:
            while not following.done():
                await device.publish("m/7", "21.5")
                await asyncio.sleep(0.1)
        assert (await following).degc.tolist() == [21.5]
        await cycles.aclose()


CONNACK, SUBACK = b"\x20\x02\x00\x00", b"\x90%c\x00\x01"


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ([], "timed out"),
        ([CONNACK], "timed out"),
        ([CONNACK, SUBACK % 3 + b"\x00"], "has passed on no number for three cycle periods"),
        ([CONNACK, SUBACK % 3 + b"\x80"], "refuses 'm/7': let `user_name` read it, or correct `topic`"),
        ([b"HTTP/1.1 400 Bad Request\r\n\r\n"], "check address, `port`, `tls`"),
    ],
)
async def test_a_broker_that_falls_silent_or_refuses_a_topic_is_a_lost_link(answers: list[bytes], said: str) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for answer in answers:
            await reader.read(4096)
            writer.write(answer)
        await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    section = {"host": "127.0.0.1", "port": server.sockets[0].getsockname()[1], "timeout_s": 0.5}
    opened = MqttSource(source("mqtt", section, {**SENSOR, "topic": "m/7"}, period_s=0.05), SystemClock())
    with pytest.raises(LinkError, match=re.escape(said)):
        await following(opened.cycles())
    await opened.close()
    server.close()


@pytest.mark.wires
async def test_a_broker_that_ends_the_connection_leaves_nothing_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    for answers in ([], [CONNACK], [CONNACK, b""], [CONNACK, SUBACK % 3 + b"\x00"]):

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, answers: Any = answers) -> None:
            for answer in answers:
                await reader.read(4096)
                writer.write(answer)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        section = {"host": "127.0.0.1", "port": server.sockets[0].getsockname()[1], "timeout_s": 0.5}
        opened = MqttSource(source("mqtt", section, {**SENSOR, "topic": "m/7"}, period_s=0.05), SystemClock())
        with pytest.raises(LinkError, match=r"broker 127\.0\.0\.1:\d+"):
            await following(opened.cycles())
        await opened.close()
        server.close()
        del opened
    gc.collect()  # a future that holds an error which nobody took is logged when it goes
    await asyncio.sleep(0)
    assert not [record for record in caplog.records if record.name == "asyncio"]


async def test_a_second_device_at_the_broker_is_told(broker: int, tmp_path: Path) -> None:
    async with aiomqtt.Client("127.0.0.1", broker, username="toolpoint", password="right") as device:
        opened = subscribed(broker, tmp_path, "right")
        cycles = opened.cycles()
        waiting = asyncio.ensure_future(following(cycles))
        cycle = None
        async with asyncio.timeout(PATIENCE_S):
            while cycle is None or not cycle.faults:
                for text in ("21.5", "31.5"):
                    await device.publish("m/7", text, qos=1)
                    await asyncio.sleep(0.02)
                if waiting.done():
                    cycle, waiting = waiting.result(), asyncio.ensure_future(following(cycles))
        assert list(cycle.reason) == [Reason.DUPLICATE_ID] and "between 21.5 and 31.5 degC" in cycle.faults[0]
        waiting.cancel()
        await opened.close()


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (ua.DataValue(ua.Variant(21.5, ua.VariantType.Double)), 21.5),
        (ua.DataValue(ua.Variant(21, ua.VariantType.Int16)), 21.0),
        (ua.DataValue(ua.Variant(True, ua.VariantType.Boolean)), Reason.UNREADABLE),
        (ua.DataValue(ua.Variant("21.5", ua.VariantType.String)), 21.5),
        (ua.DataValue(ua.Variant("21,5", ua.VariantType.String)), Reason.UNREADABLE),
        (ua.DataValue(ua.Variant("0x15", ua.VariantType.String)), Reason.UNREADABLE),
        (ua.DataValue(ua.Variant("nan", ua.VariantType.String)), Reason.UNREADABLE),
        (ua.DataValue(ua.Variant([21.5], ua.VariantType.Double)), Reason.UNREADABLE),
        (ua.DataValue(ua.Variant(None, ua.VariantType.Null)), Reason.NOT_RECEIVED),
        (ua.DataValue(None), Reason.NOT_RECEIVED),
        (
            ua.DataValue(ua.Variant(21.5), UNCERTAIN),
            Reason.DEVICE_ERROR,
        ),
        (ua.DataValue(None, ua.StatusCode(ua.UInt32(ua.StatusCodes.BadNodeIdUnknown))), Reason.NOT_RECEIVED),
        (
            ua.DataValue(ua.Variant(21.5), ua.StatusCode(ua.UInt32(ua.StatusCodes.GoodLocalOverride))),
            Reason.DEVICE_ERROR,
        ),
        (ua.DataValue(ua.Variant(21.5), ua.StatusCode(ua.UInt32(ua.StatusCodes.GoodClamped))), Reason.DEVICE_ERROR),
        (ua.DataValue(ua.Variant(21.5), ua.StatusCode(ua.UInt32(0x0000_0600))), Reason.DEVICE_ERROR),
        (ua.DataValue(ua.Variant(21.5), ua.StatusCode(ua.UInt32(0x0000_0400))), 21.5),
    ],
)
def test_tags(answer: ua.DataValue, found: float | Reason) -> None:
    number = reading_of(answer, "s=T")
    assert (number.reason if isinstance(number, NoReading) else number) == found
