"""`toolpoint sources` and the demo with sensors on other wires than LATSIS lines."""

import asyncio
import json
import math
import socket
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from asyncua import Server, ua
from click.testing import CliRunner

from config.machines import shipped_file
from daemon.cli import main
from daemon.simulation.processes import free_port
from drivers.sim.wires.modbus_box import ModbusTcpBox

REPOSITORY = Path(__file__).parents[2]


def test_two_commands_lead_from_the_sample_to_a_live_value_of_a_simulated_box(tmp_path: Path) -> None:
    target, runner = tmp_path / "toolpoint.yaml", CliRunner()
    first = runner.invoke(main, ["sample-config", "--machine", "pt100", "--output", str(target)])
    assert first.exit_code == 0, first.output
    second = runner.invoke(main, ["sources", "read", "--simulated", "--config", str(target)])
    assert second.exit_code == 0, second.output
    assert "source pt100 (modbus; NOT encrypted" in second.output
    assert "1 (Spindle unit, Housing)" in second.output and "degC" in second.output


class Box:
    """A box in a thread of its own, because a command's loop is its own too."""

    def __init__(self, words: Sequence[int | None]) -> None:
        self._words = words
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._ready.wait(20)

    async def _serve(self) -> None:
        def contents(_unit: int, _table: str, start: int, count: int) -> list[int] | None:
            found = list(self._words[start : start + count])
            return [word & 0xFFFF for word in found if word is not None] if None not in found else None

        box = ModbusTcpBox(contents)
        await box.start()
        self.port, self._loop, self._end = box.port, asyncio.get_running_loop(), asyncio.Event()
        self._ready.set()
        await self._end.wait()
        await box.stop()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


@pytest.fixture
def box() -> Iterator[Box]:
    made = Box([231, -999, 240, 1500, 240, 240, 240, 240])
    yield made
    made.stop()


def described(folder: Path, **modbus: Any) -> Path:
    content = yaml.safe_load(shipped_file("pt100.yaml").read_text(encoding="utf-8"))
    content["temperatures"]["sources"][0]["modbus"] |= {"host": "127.0.0.1", **modbus}
    path = folder / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.mark.wires
def test_open_and_impossible_sensors_are_shown_as_such(tmp_path: Path, box: Box) -> None:
    path = described(tmp_path, port=box.port)
    read = CliRunner().invoke(main, ["sources", "read", "--config", str(path), "--json", "-"])
    assert read.exit_code == 1, read.output
    source = json.loads(read.stdout)["sources"]["pt100"]
    assert source["problem"] is None and source["missing"] == 1
    assert source["sensors"]["1"] == {"degc": 23.1, "reason": ""}
    assert source["sensors"]["2"] == {"degc": None, "reason": "sensor reports an error"}
    assert source["sensors"]["4"]["degc"] == 150.0  # cleansing refuses it: no narrower range is configured
    assert "source pt100: sensor 2 (Spindle unit, Housing): reads -999" in source["faults"][0]


@pytest.mark.wires
def test_a_box_that_is_not_there_is_said_with_what_to_check(tmp_path: Path) -> None:
    path = described(tmp_path, port=1, timeout_s=0.5)
    read = CliRunner().invoke(main, ["sources", "read", "--config", str(path)])
    assert read.exit_code == 1
    assert "source pt100: 127.0.0.1:1 cannot be reached within 0.5 s" in read.output


@pytest.mark.wires
def test_check_reads_the_box_and_says_that_it_is_not_encrypted(tmp_path: Path, box: Box) -> None:
    checked = CliRunner().invoke(main, ["check", "--config", str(described(tmp_path, port=box.port)), "--json", "-"])
    (finding,) = (each for each in json.loads(checked.stdout) if each["subject"] == "source pt100")
    assert finding["passed"] and "7 sensors" in finding["detail"] and "NOT encrypted" in finding["detail"]


def pasted(output: str, path: Path) -> Path:
    """Put what a scan printed into a configuration, as a person would."""
    content = yaml.safe_load(shipped_file("pt100.yaml").read_text(encoding="utf-8"))
    content["temperatures"] = yaml.safe_load(output)["temperatures"]
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.mark.wires
def test_a_scan_finds_the_registers_of_a_box_and_what_it_prints_can_be_pasted(tmp_path: Path, box: Box) -> None:
    runner = CliRunner()
    words = ["sources", "scan", "modbus", f"127.0.0.1:{box.port}", "--registers", "8"]
    both = runner.invoke(main, [*words, "--units", "1-2"])
    assert both.stdout.count("# 23.1 degC") == 2 and "unit_id: 2" in both.stdout, "a box of each unit, from one table"
    found = runner.invoke(main, words)
    assert found.exit_code == 0, found.output
    assert found.stdout.count("# 23.1 degC") == 1 and "# open sensor" in found.stdout
    assert "150" not in found.stdout, "150 degC are not proposed"
    path = pasted(found.stdout, tmp_path / "toolpoint.yaml")
    read = runner.invoke(main, ["sources", "read", "--config", str(path), "--json", "-"])
    source = json.loads(read.stdout)["sources"]["modbus"]
    assert source["sensors"]["401"]["degc"] == 23.1
    assert source["sensors"]["402"] == {"degc": None, "reason": "sensor reports an error"}


@pytest.mark.wires
def test_a_scan_that_finds_nothing_says_what_to_try(tmp_path: Path) -> None:
    runner = CliRunner()
    nobody = runner.invoke(main, ["sources", "scan", "modbus", "127.0.0.1:1"])
    assert nobody.exit_code == 1 and "127.0.0.1:1 cannot be reached" in nobody.output
    odd = runner.invoke(main, ["sources", "scan", "modbus", "127.0.0.1:1", "--units", "1-900"])
    assert odd.exit_code == 2 and "such as 1 or 1-16" in odd.output
    for place in ("modbus 127.0.0.1:99999", "modbus 127.0.0.1:0", "mqtt 127.0.0.1:0", "modbus 127.0.0.1:²"):
        beyond = runner.invoke(main, ["sources", "scan", *place.split()])
        assert beyond.exit_code == 2 and "the port must be a number from 1 to 65535" in beyond.output
    with socket.create_server(("127.0.0.1", 0)) as mute:
        deaf = runner.invoke(main, ["sources", "scan", "modbus", f"127.0.0.1:{mute.getsockname()[1]}"])
    assert deaf.exit_code == 1 and "looks like a temperature" not in deaf.output, "nothing was read"
    assert "unit 1 does not answer as a Modbus box: check place, wires, --units" in deaf.output
    refusing = Box([None] * 16)
    without = runner.invoke(main, ["sources", "scan", "modbus", f"127.0.0.1:{refusing.port}"])
    refusing.stop()
    assert "no register from 0 to 15 looks like a temperature" in without.output, "it answers, and has none"
    tags = runner.invoke(main, ["sources", "scan", "opcua", "127.0.0.1:1"])
    assert tags.exit_code == 1 and tags.output.count("\n") == 1 and "127.0.0.1:1 was lost" in tags.output
    empty = runner.invoke(main, ["sources", "scan", "kernel", str(tmp_path)])
    assert empty.exit_code == 1 and "the kernel shows no temperature" in empty.output
    silent = runner.invoke(main, ["sources", "scan", "mqtt", "127.0.0.1:1", "--seconds", "0.5"])
    assert silent.exit_code == 1 and "127.0.0.1:1 cannot be reached" in silent.output


class Gateway:
    """A server with tags in a thread of its own."""

    def __init__(self) -> None:
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._ready.wait(60)

    async def _serve(self) -> None:
        server = Server()
        await server.init()
        self.endpoint = f"opc.tcp://127.0.0.1:{free_port()}/gateway"
        server.set_endpoint(self.endpoint)
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        index = await server.register_namespace("urn:gateway")
        folder = await server.nodes.objects.add_folder(ua.NodeId("Machine", index), "Machine")
        for name, value, unit in (("Column", 23.5, "\u00b0C"), ("Gauge", 0.125, "mm"), ("Count", 7, "")):
            tag = await folder.add_variable(ua.NodeId(name, index), name, value)
            if unit:
                about = ua.EUInformation(DisplayName=ua.LocalizedText(unit))
                await tag.add_property(ua.NodeId(f"{name}.EU", index), ua.QualifiedName("EngineeringUnits", 0), about)
                await tag.add_property(ua.NodeId(f"{name}.P", index), ua.QualifiedName("ValuePrecision", 0), 3.0)
        await folder.add_variable(ua.NodeId("Name", index), "Name", "a text")
        await folder.add_variable(ua.NodeId("Inputs", index), "Inputs", [20.5, math.nan, 22.5])
        await server.start()
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        self._ready.set()
        await self._end.wait()
        await server.stop()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


@pytest.fixture
def gateway() -> Iterator[Gateway]:
    made = Gateway()
    yield made
    made.stop()


@pytest.mark.wires
def test_a_scan_lists_the_numbers_of_a_server_with_their_units_and_can_be_pasted(
    tmp_path: Path, gateway: Gateway
) -> None:
    runner = CliRunner()
    found = runner.invoke(main, ["sources", "scan", "opcua", gateway.endpoint])
    assert found.exit_code == 0, found.output
    content = yaml.safe_load(found.stdout)
    (source,) = content["temperatures"]["sources"]
    places = [(sensor["node"], sensor.get("element")) for sensor in source["opcua"]["sensors"]]
    assert places == [("s=Column", None), ("s=Count", None), ("s=Inputs", 0), ("s=Inputs", 2)]
    assert "# Column: 23.5 \u00b0C" in found.stdout and "# Count: 7 (no unit is given)" in found.stdout
    (gauges,) = content["displacements"]["sources"]
    assert gauges["opcua"]["channels"] == [{"name": "Gauge", "node": "s=Gauge", "unit": "mm"}]
    path = pasted(found.stdout, tmp_path / "toolpoint.yaml")
    whole = yaml.safe_load(path.read_text(encoding="utf-8")) | {"displacements": content["displacements"]}
    path.write_text(yaml.safe_dump(whole), encoding="utf-8")
    read = runner.invoke(main, ["sources", "read", "--config", str(path), "--json", "-"])
    sources = json.loads(read.stdout)["sources"]
    assert [sources["opcua"]["sensors"][each]["degc"] for each in ("401", "404")] == [23.5, 22.5]
    assert sources["gauges"]["channels"]["Gauge"]["um"] == pytest.approx(125.0)
    nobody = runner.invoke(main, ["sources", "scan", "opcua", "127.0.0.1:1"])
    assert (
        nobody.exit_code == 1 and "127.0.0.1:1 was lost while connecting: nothing listens there: check" in nobody.output
    )
