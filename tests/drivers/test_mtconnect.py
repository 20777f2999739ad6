"""A control behind an MTConnect agent: what is read, that nothing is written, and what a bad agent may not do."""

import asyncio
import contextlib
import gzip
import math
import re

import pytest
import pytest_asyncio
from control_rig import HandClock, machine, record_for
from hypothesis import given, settings
from hypothesis import strategies as st
from scripted_machine import ScriptedNc, cnc_config

from daemon.cnc.interlocks import Interlocks
from drivers.clock import SystemClock
from drivers.contract import Capability, LinkError, NotSentError
from drivers.mtconnect.cnc import MtconnectCnc, fetch
from drivers.mtconnect.device import MOST_FAULTS, DataItem, Device, data_items
from drivers.mtconnect.xml import DEEPEST, LONGEST_DOCUMENT, XmlError, parsed
from drivers.sim.wires.mtconnect_agent import BUFFER, SimulatedMtconnectAgent
from models.records import CncMode, CncRun


class AgentBench:
    def __init__(self):
        self.nc = ScriptedNc()
        self.agent = SimulatedMtconnectAgent(self.nc, cnc_config(mtconnect={"url": "http://127.0.0.1:1"}), port=0)

    @property
    def port(self):
        return self.agent.port

    def open(self, **changes):
        return self.open_at(self.port, **changes)

    def open_at(self, port, *, section=None, **changes):
        section = {"position_items": {"Z": "zact"}} | (section or {})
        mtconnect = {"url": f"http://127.0.0.1:{port}", "motor_temperature_item": "heat", **section}
        return MtconnectCnc(cnc_config(mtconnect=mtconnect, **changes), SystemClock())


@pytest_asyncio.fixture
async def bench():
    made = AgentBench()
    await made.agent.start()
    yield made
    await made.agent.stop()


@pytest.mark.wires
async def test_state_program_and_speed_are_read_and_writing_is_refused_with_a_sentence(bench):
    cnc = bench.open()
    await cnc.connect()
    sample = await cnc.read([500])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, False)
    assert (sample.program, sample.sequence_number, sample.work_offset, sample.tool_number) == (1000, 20, 54, 3)
    assert (sample.spindle_speed_rpm, sample.motor_temperature_degc) == (5000.0, 31.5)
    assert sample.macros == {500: None}
    with pytest.raises(NotSentError, match="read and never written: reach the control by another driver"):
        await cnc.write_macros([[(500, 1.0)]])
    assert {Capability.READ_MACROS, Capability.WRITE_MACROS, Capability.CLOCK} <= set(cnc.cannot)
    bench.nc.run, bench.nc.alarm, bench.nc.program, bench.nc.sequence_number = 2, 1, 17, 100
    sample = await cnc.read([])
    assert (sample.run, sample.alarm, sample.program, sample.sequence_number) == (CncRun.HOLD, True, 17, 100)
    bench.nc.alarm = 0
    assert not (await cnc.read([])).alarm
    bench.agent.available = False
    sample = await cnc.read([])
    assert (sample.run, sample.program) == (CncRun.UNKNOWN, 0) and math.isnan(sample.spindle_speed_rpm)
    await cnc.close()


ERRORS = {
    "1.0": '<m:Error errorCode="{}">{}</m:Error>',
    "1.8": '<m:Errors><m:Error errorCode="{}">{}</m:Error></m:Errors>',
    "2.6": '<m:Errors><m:OutOfRange errorCode="{}"><m:ErrorMessage>{}</m:ErrorMessage></m:OutOfRange></m:Errors>',
}
"""How agents of different versions tell one error."""


@pytest.mark.wires
@pytest.mark.parametrize("version", ERRORS)
async def test_what_the_agent_has_forgotten_is_read_anew_and_another_instance_is_another_link(bench, version):
    bench.agent._error = lambda code, words: (
        f'<m:MTConnectError xmlns:m="urn:mtconnect.org:MTConnectError:{version}">'
        f"<m:Header/>{ERRORS[version].format(code, words)}</m:MTConnectError>"
    )
    cnc = bench.open()
    await cnc.connect()
    for number in range(BUFFER + 10):
        bench.nc.sequence_number = number
        bench.agent.look()
    assert (await cnc.read([])).sequence_number == BUFFER + 9
    bench.agent.restart()
    with pytest.raises(LinkError, match="started anew"):
        await cnc.read([])
    with pytest.raises(LinkError):
        await cnc.read([])
    await cnc.close()


UUID, SENDER, CHANGED = 'uuid="toolpoint-simulated"', ' sender="', " deviceModelChangeTime="


@pytest.mark.wires
@pytest.mark.parametrize(
    ("own", "told", "later", "words"),
    [
        (UUID, UUID, 'uuid="serial-4711"', "has the uuid serial-4711 now"),
        (SENDER, SENDER, f'{CHANGED}"2026-11-22T00:00:01Z"{SENDER}', None),
        (
            SENDER,
            f'{CHANGED}"2026-11-22T00:00:01Z"{SENDER}',
            f'{CHANGED}"2026-11-22T00:00:02Z"{SENDER}',
            "devices were changed",
        ),
    ],
    ids=["an adapter's * uuid", "told in some answers", "another device file"],
)
async def test_a_device_that_changes_while_the_agent_runs_is_another_link(bench, own, told, later, words):
    """Its observations counted for no device, and the state stayed what it was, of an agent that lives."""
    made, present = bench.agent._answer, told
    bench.agent._answer = lambda target: made(target).replace(own, present)
    cnc = bench.open()
    await cnc.connect()
    present, bench.nc.run = later, 0
    if words is None:
        assert (await cnc.read([])).run is CncRun.RESET
    else:
        with pytest.raises(LinkError, match=words):
            await cnc.read([])
    await cnc.close()


@pytest.mark.wires
async def test_an_agent_of_a_whole_plant_is_asked_for_its_device_alone():
    """Sixty machines with some hundred data items each: all of them are more than is read."""

    def probe(machines):
        items = "".join(f'<DataItem id="x%d-{n}" type="POSITION" category="SAMPLE"/>' for n in range(700))
        kept = '<DataItem id="e%d" type="EXECUTION" category="EVENT"/>'
        return "".join(
            f'<Device name="M{n}" uuid="u{n}"><DataItems>{(kept + items).replace("%d", str(n))}</DataItems></Device>'
            for n in machines
        )

    async def serve(reader, writer):
        path = (await reader.readuntil(b"\r\n\r\n")).split()[1].decode()
        header = '<Header instanceId="1" nextSequence="5" lastSequence="4" creationTime="2026-01-01T00:00:00Z"/>'
        asked.append(path)
        if path.endswith("/probe"):
            content = f"<Devices>{probe([7] if path == '/M7/probe' else range(60))}</Devices>"
            body = f"<MTConnectDevices>{header}{content}</MTConnectDevices>"
        else:
            body = f"<MTConnectStreams>{header}<Streams/></MTConnectStreams>"
        if path.startswith("/M99/"):
            body = '<MTConnectError><Errors><Error errorCode="NO_DEVICE">no M99</Error></Errors></MTConnectError>'
        writer.write(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n" + body.encode())
        writer.close()

    asked = []
    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    section = {"position_items": {}, "motor_temperature_item": None}
    cnc = AgentBench().open_at(port, section=section | {"device": "M7"})
    await cnc.connect()
    assert cnc.identity == "mtconnect:u7" and set(asked) == {"/M7/probe", "/M7/current", "/M7/sample?from=5&count=500"}
    await cnc.close()
    unknown = AgentBench().open_at(port, section=section | {"device": "M99"})
    with pytest.raises(LinkError, match="longer than"):  # what a smaller plant would be told is which names there are
        await unknown.connect()
    server.close()


@pytest.mark.wires
async def test_what_is_no_agent_is_named_with_its_status():
    async def login(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        body = b"<html><body>Log in<br></body></html>"
        writer.write(b"HTTP/1.1 401 Unauthorized\r\nContent-Length: %d\r\n\r\n" % len(body) + body)
        writer.close()

    server = await asyncio.start_server(login, "127.0.0.1", 0)
    cnc = AgentBench().open_at(server.sockets[0].getsockname()[1])
    with pytest.raises(LinkError, match="HTTP status 401 and no document of an agent"):
        await cnc.connect()
    await cnc.close()
    server.close()


@pytest.mark.wires
async def test_an_agent_behind_a_server_that_compresses_and_begins_with_an_empty_line_is_read(bench):
    """Who does not say otherwise takes every coding (RFC 9110, 12.5.3)."""

    async def proxy(reader, writer):
        request = await reader.readuntil(b"\r\n\r\n")
        status, body = await fetch("127.0.0.1", bench.port, request.split()[1].decode())
        body, coding = b"\r\n" + body, b""
        if b"identity" not in request:
            body, coding = gzip.compress(body), b"Content-Encoding: gzip\r\n"
        writer.write(b"HTTP/1.1 %d OK\r\n%bContent-Length: %d\r\n\r\n" % (status, coding, len(body)) + body)
        writer.close()

    server = await asyncio.start_server(proxy, "127.0.0.1", 0)
    cnc = bench.open_at(server.sockets[0].getsockname()[1])
    await cnc.connect()
    assert (await cnc.read([])).program == 1000
    await cnc.close()
    server.close()


@pytest.mark.wires
async def test_the_output_stays_refused_with_the_reason(tmp_path, bench):
    configuration = machine(tmp_path)
    cnc = bench.open()
    await cnc.connect()
    record = record_for(configuration)
    inhibit = Interlocks(configuration, HandClock(), record, lambda: "", "").write_inhibit(cnc)
    assert inhibit is not None and "read and never written" in inhibit.text and "another driver" in inhibit.remedy
    await cnc.close()


def test_names_of_programs_and_blocks_become_numbers():
    items = tuple(
        DataItem(item_id=kind, name="", kind=kind, subtype="")
        for kind in ("EXECUTION", "BLOCK", "LINE_LABEL", "WORK_OFFSET", "TOOL_NUMBER")
    )
    items += (DataItem(item_id="PROGRAM", name="", kind="PROGRAM", subtype="MAIN"),)
    device = Device(name="x", uuid="y", items=items)
    for name, number in (("O1000", 1000), ("1000.NC", 1000), ("//CNC_MEM/USER/PATH1/O0017", 17), ("", 0)):
        device.values["PROGRAM"] = name
        assert device.program == number, name
    device.values["PROGRAM"] = "HOUSING_A.MPF"
    first = device.program
    device.values["PROGRAM"] = "HOUSING_B.MPF"
    assert first != device.program and min(first, device.program) >= 100_000_000
    for block, number in (("N100 G0 X1", 100), ("/N7 M1", 7), ("G1 X2 (N5)", 0), ("UNAVAILABLE", 0)):
        device.values["BLOCK"] = block
        assert device.sequence_number == number, block
    device.values["LINE_LABEL"] = "N250"
    assert device.sequence_number == 250
    for offset, number in (("G54", 54), ("54", 54), ("G54.1 P3", 541003), ("-", 0)):
        device.values["WORK_OFFSET"] = offset
        assert device.work_offset == number, offset


def speed(item_id, kind="ROTARY_VELOCITY", subtype="ACTUAL", unit="REVOLUTION/MINUTE"):
    return DataItem(item_id=item_id, name=item_id, kind=kind, subtype=subtype, unit=unit)


OVERRIDE = speed("Sovr", subtype="OVERRIDE", unit="PERCENT")
COMMANDED = speed("Scmd", subtype="COMMANDED")


@pytest.mark.parametrize(
    ("items", "named", "chosen", "why"),
    [
        ((OVERRIDE, speed("Sact")), None, "Sact", None),
        ((OVERRIDE, speed("Sold", "SPINDLE_SPEED", "")), None, "Sold", None),
        ((OVERRIDE, COMMANDED), None, None, "no data item of type ROTARY_VELOCITY"),
        ((speed("Sact", unit="REVOLUTION/SECOND"),), None, None, "Sact is in REVOLUTION/SECOND, not in REVOLUTION/MIN"),
        (
            (speed("S1"), speed("B")),
            None,
            None,
            r"2 data items of ROTARY_VELOCITY \(S1, B\): name the spindle's in cnc\.",
        ),
        ((speed("S1"), speed("B")), "B", "B", None),
        ((OVERRIDE,), "Sovr", None, "Sovr is in PERCENT"),
    ],
)
def test_the_speed_is_the_spindle_s_actual_one_or_none_with_the_reason(items, named, chosen, why):
    execution = DataItem(item_id="EXECUTION", name="", kind="EXECUTION", subtype="")
    device = Device(name="x", uuid="y", items=(execution, *items), spindle_item=named)
    device.values |= {item.item_id: "100" for item in items if item.item_id != chosen}
    device.values |= {chosen: "4711"} if chosen else {}
    told = device.number(Capability.SPINDLE_SPEED)
    assert told == 4711.0 if chosen else math.isnan(told)
    assert re.search(why, device.cannot[Capability.SPINDLE_SPEED]) if why else "spindle_speed" not in device.cannot


def test_an_average_a_condition_and_a_series_are_no_present_speed_and_every_emergency_stop_counts():
    text = """<D><DataItem id="mean" category="SAMPLE" type="ROTARY_VELOCITY" subType="ACTUAL" statistic="AVERAGE"/>
    <DataItem id="series" category="SAMPLE" type="ROTARY_VELOCITY" subType="ACTUAL" representation="TIME_SERIES"/>
    <DataItem id="state" category="CONDITION" type="ROTARY_VELOCITY" subType="ACTUAL"/>%s
    <DataItem id="run" category="EVENT" type="EXECUTION" representation="VALUE"/>
    <DataItem id="door" category="EVENT" type="EMERGENCY_STOP"/>
    <DataItem id="panel" category="EVENT" type="EMERGENCY_STOP"/></D>"""
    real = '<DataItem id="speed" category="SAMPLE" type="ROTARY_VELOCITY" subType="ACTUAL" representation="VALUE"/>'
    values = {"mean": "4000", "series": "1 2", "speed": "5000", "run": "ACTIVE", "door": "ARMED", "panel": "TRIGGERED"}

    def device(item, named=None):
        items = tuple(data_items(asyncio.run(parsed((text % item).encode()))))
        return Device(name="x", uuid="y", items=items, spindle_item=named, values=dict(values))

    assert device(real).number(Capability.SPINDLE_SPEED) == 5000.0
    assert math.isnan(device("").number(Capability.SPINDLE_SPEED)) and "spindle_speed" in device("").cannot
    assert device("", "mean").number(Capability.SPINDLE_SPEED) == 4000.0, "who names it has it"
    assert device(real).run is CncRun.START and device(real).alarm
    values["panel"] = "ARMED"
    assert not device(real).alarm


def test_of_two_faults_one_ends_and_the_other_stays():
    """Since 2.3 a conditionId tells activations apart, before that the nativeCode does."""
    items = tuple(DataItem(item_id=kind, name="", kind=kind, subtype="") for kind in ("EXECUTION", "SYSTEM"))
    for code in ("conditionId", "nativeCode"):
        device = Device(name="x", uuid="y", items=items)
        for told, alarm in (("Fault 1", True), ("Fault 2", True), ("Normal 1", True), ("Normal 2", False)):
            state, number = told.split()
            text = f'<{state} dataItemId="SYSTEM" {code}="{number}"/>'
            text = (
                f"<a><DeviceStream><ComponentStream><Condition>{text}</Condition></ComponentStream></DeviceStream></a>"
            )
            device.observe(asyncio.run(parsed(text.encode())), anew=False)
            assert device.alarm == alarm, told


def test_an_agent_that_invents_items_or_faults_does_not_fill_the_memory():
    items = tuple(DataItem(item_id=kind, name="", kind=kind, subtype="") for kind in ("EXECUTION", "SYSTEM"))
    device = Device(name="x", uuid="y", items=items)

    def tell(events, conditions):
        text = f"<Events>{events}</Events><Condition>{conditions}</Condition>"
        text = f"<a><DeviceStream><ComponentStream>{text}</ComponentStream></DeviceStream></a>"
        device.observe(asyncio.run(parsed(text.encode())), anew=False)

    tell('<E dataItemId="other">1</E><E dataItemId="EXECUTION">ACTIVE</E>', '<Fault dataItemId="none"/>')
    assert device.values == {"EXECUTION": "ACTIVE"} and not device.alarm and not device.faults
    tell("", '<Fault dataItemId="SYSTEM" nativeCode="7"/>')
    assert device.alarm
    tell("", '<Unavailable dataItemId="SYSTEM"/>')
    assert not device.alarm, "the adapter is away, and tells the faults that are left when it is back"
    tell("", '<Fault dataItemId="SYSTEM" nativeCode="7"/>')
    with pytest.raises(XmlError, match="SYSTEM has more than 1000 faults"):
        tell("", "".join(f'<Fault dataItemId="SYSTEM" nativeCode="c{number}"/>' for number in range(MOST_FAULTS)))


@pytest.mark.parametrize(
    "document",
    [
        b'<!DOCTYPE a [<!ENTITY x "xxxxxxxxxx"><!ENTITY y "&x;&x;&x;&x;">]><a>&y;</a>',
        b'<!DOCTYPE a SYSTEM "http://127.0.0.1/secret"><a/>',
        b"<a>" * (DEEPEST + 1),
        b"<a><b/>" + b"<c/>" * 60_000 + b"</a>",
        b"x" * (LONGEST_DOCUMENT + 1),
        b"<a>",
        b"\xff\xfe\x00",
        b"",
    ],
    ids=["entities", "external", "deep", "many", "long", "open", "bytes", "nothing"],
)
def test_a_document_that_could_harm_is_refused(document):
    with pytest.raises(XmlError):
        asyncio.run(parsed(document))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300) | st.text(alphabet="<>/ab=\"'&;! -[]", max_size=200).map(str.encode))
def test_any_bytes_are_a_document_or_refused(content):
    with contextlib.suppress(XmlError):
        assert asyncio.run(parsed(content)).name
