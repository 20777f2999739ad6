"""Every driver of a CNC passes the same checks: the example of the how-to, and each protocol over its wire.

LinuxCNC passes them at LinuxCNC itself (`test_cnc_linuxcnc.py`), the vendor's library at a stand-in of it
(`test_focas_library.py`).
"""

import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
import pytest_asyncio
from asyncua import ua
from cnc_contract import (
    CHECKS,
    WIRE_CHECKS,
    Bench,
    Check,
    WireBench,
    WireCheck,
    reconnecting_leaves_nothing_behind,
)
from pydantic import Field, create_model
from scripted_machine import ScriptedNc, ScriptedSinumerik, cnc_config

from config.schema.base import drivers_of
from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import CncConnection
from config.schema.displacements import DisplacementFileConfig
from config.schema.source_drivers import SourceConfig
from config.schema.temperatures import LineConfig
from drivers import registry
from drivers.clock import SystemClock
from drivers.contract import Cnc, LinkError
from drivers.focas.cnc import FocasCnc
from drivers.focas.codec import Answer, Ask, Function
from drivers.haas.cnc import HaasCnc
from drivers.haas.codec import encode_fields
from drivers.mtconnect.cnc import MtconnectCnc
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.wires.focas_server import SimulatedFocasServer
from drivers.sim.wires.haas_server import SimulatedHaasServer
from drivers.sim.wires.mtconnect_agent import SimulatedMtconnectAgent
from drivers.sim.wires.opcua_server import SimulatedCncServer

GUIDE = Path(__file__).parents[2] / "docs/how-to/write-a-driver.md"


def of_the_guide() -> dict[str, Any]:
    """Return what the Python of the how-to defines."""
    defined: dict[str, Any] = {"CncConnection": CncConnection, "ClassVar": ClassVar, "Field": Field}
    for block in re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        exec(block, defined)
    return defined


class ExampleBench:
    """The how-to's driver at a control that takes #500 to #505."""

    def __init__(self) -> None:
        self._guide = of_the_guide()
        self._config = create_model(
            "ExampleCncConfig",
            __base__=CncConfig,
            driver=(Literal["example"], "example"),
            example=(self._guide["ExampleConfig"] | None, None),
        )
        self._guide["CONTROLS"]["here"] = dict.fromkeys(range(500, 506))

    def open(self, **changes: Any) -> Cnc:
        section = self._guide["ExampleConfig"](host="here")
        macros = cnc_config().macros
        config = self._config(**{"macros": macros, "example": section, "allow_insecure_writes": True, **changes})
        driver: Cnc = self._guide["ExampleCnc"](config, SystemClock())
        return driver

    async def lose(self) -> None:
        del self._guide["CONTROLS"]["here"]

    def refuse(self, number: int) -> None:
        del self._guide["CONTROLS"]["here"][number]


class SimulatedBench(ABC):
    """A driver at one of the simulated servers."""

    _server: SimulatedCncServer | SimulatedFocasServer | SimulatedHaasServer | SimulatedMtconnectAgent

    async def start(self) -> None:
        await self._server.start()

    async def stop(self) -> None:
        await self._server.stop()

    def open(self, **changes: Any) -> Cnc:
        return self.open_at(self.port, **changes)

    @property
    def port(self) -> int:
        return self._server.port

    @abstractmethod
    def open_at(self, port: int, **changes: Any) -> Cnc:
        """Return a connection that is not open yet to whatever listens at a port of this computer."""


class OpcUaBench(SimulatedBench):
    """The OPC UA driver at the simulated server."""

    def __init__(self) -> None:
        self._nc = ScriptedNc()
        self._server = SimulatedCncServer(self._nc, cnc_config(), port=0)

    def open_at(self, port: int, **changes: Any) -> Cnc:
        return OpcUaCnc(cnc_config(f"opc.tcp://127.0.0.1:{port}/cnc", **changes), SystemClock())

    def written(self) -> list[int]:
        return [number for number, _ in self._nc.macros.written]

    async def lose(self) -> None:
        await self._server.stop()

    def refuse(self, number: int) -> None:
        del self._nc.macros.values[number]

    def mistype(self, number: int) -> None:
        assert self._server._server is not None
        space = self._server._server.iserver.aspace
        names = (f"Macro.{number}", f"/Channel/Parameter/R[u1,{number}]")
        (node,) = (each for each in space.keys() if each.Identifier in names)  # noqa: SIM118
        words = ua.DataValue(ua.Variant("MUCH", ua.VariantType.String))
        space.set_attribute_value_callback(node, ua.AttributeIds.Value, lambda *_: words)


class SinumerikBench(OpcUaBench):
    """The OPC UA driver at the simulated SINUMERIK."""

    def __init__(self) -> None:
        self._nc = ScriptedSinumerik()
        self._server = SimulatedCncServer(self._nc, cnc_config(preset="sinumerik", namespace_uri=None), port=0)

    def open_at(self, port: int, **changes: Any) -> Cnc:
        return super().open_at(port, preset="sinumerik", namespace_uri=None, **changes)


class FocasBench(SimulatedBench):
    """The FOCAS driver at the simulated server."""

    def __init__(self) -> None:
        config = cnc_config(focas={"host": "127.0.0.1"})
        self._nc = ScriptedNc()
        self._server = SimulatedFocasServer(self._nc, config, port=0)

    def open_at(self, port: int, **changes: Any) -> Cnc:
        return FocasCnc(cnc_config(focas={"host": "127.0.0.1", "port": port}, **changes), SystemClock())

    def written(self) -> list[int]:
        return [number for number, _ in self._nc.macros.written]

    async def lose(self) -> None:
        await self._server.stop()

    def refuse(self, number: int) -> None:
        self._server.responder.refused_macros[number] = PROTECTED

    def mistype(self, number: int) -> None:
        responder = self._server.responder
        shown = responder._read_macros

        def read(ask: Ask) -> Answer:
            first, last, *_ = ask.arguments
            return Answer(0, b"MUCH" * 2 * (last - first + 1)) if first <= number <= last else shown(ask)

        responder._answers = {**responder._answers, Function.READ_MACRO: read}


class HaasBench(SimulatedBench):
    """The Haas driver at the simulated server."""

    def __init__(self) -> None:
        self._nc = ScriptedNc()
        self._server = SimulatedHaasServer(self._nc, cnc_config(haas={"host": "127.0.0.1"}), port=0)

    def open_at(self, port: int, **changes: Any) -> Cnc:
        return HaasCnc(cnc_config(haas={"host": "127.0.0.1", "port": port}, **changes), SystemClock())

    def written(self) -> list[int]:
        return [number for number, _ in self._nc.macros.written]

    async def lose(self) -> None:
        await self._server.stop()

    def refuse(self, number: int) -> None:
        self._server.responder.refused_macros.add(number)

    def mistype(self, number: int) -> None:
        responder = self._server.responder
        shown = responder.answer
        numbered = [str(number)] if responder.numbered else []

        def answer(line: str) -> bytes:
            return encode_fields("MACRO", *numbered, "MUCH") if line.strip() == f"?Q600 {number}" else shown(line)

        responder.answer = answer  # type: ignore[method-assign]


class UnnumberedHaasBench(HaasBench):
    """A control that does not name the macro variable in its answers, as newer ones do."""

    def __init__(self) -> None:
        super().__init__()
        self._server.responder.numbered = False


class MtconnectBench(SimulatedBench):
    """The MTConnect driver at the simulated agent: everything is read, nothing is written."""

    def __init__(self) -> None:
        self._nc = ScriptedNc()
        self._server = SimulatedMtconnectAgent(self._nc, cnc_config(mtconnect={"url": "http://127.0.0.1:1"}), port=0)

    def open_at(self, port: int, **changes: Any) -> Cnc:
        section = {"url": f"http://127.0.0.1:{port}", "motor_temperature_item": "heat", "position_items": {"Z": "zact"}}
        return MtconnectCnc(cnc_config(mtconnect=section, **changes), SystemClock())

    def written(self) -> list[int]:
        return [number for number, _ in self._nc.macros.written]

    async def lose(self) -> None:
        await self._server.stop()

    def refuse(self, number: int) -> None:
        raise AssertionError("nothing is ever written")

    def mistype(self, number: int) -> None:
        self._nc.spindle_speed_rpm = 4321.0
        shown = self._server._answer
        self._server._answer = lambda target: shown(target).replace(">4321<", ">MUCH<")  # type: ignore[method-assign]


BENCHES = {
    "opcua": OpcUaBench,
    "sinumerik": SinumerikBench,
    "focas": FocasBench,
    "haas": HaasBench,
    "haas without numbers": UnnumberedHaasBench,
    "mtconnect": MtconnectBench,
}
PROTECTED = 7


@pytest_asyncio.fixture(params=["example", *BENCHES])
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    if request.param == "example":
        yield ExampleBench()
        return
    served = BENCHES[request.param]()
    await served.start()
    yield served
    await served.stop()


@pytest.mark.wires
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
async def test_every_driver_does_what_the_daemon_relies_on(bench: Bench, check: Check) -> None:
    await check(bench)


@pytest_asyncio.fixture(params=["opcua", "focas", "haas", "mtconnect"])
async def wired(request: pytest.FixtureRequest) -> AsyncIterator[WireBench]:
    served = BENCHES[request.param]()
    await served.start()
    yield served
    await served.stop()


@pytest.mark.wires
@pytest.mark.parametrize("check", WIRE_CHECKS, ids=lambda check: check.__name__)
async def test_every_wire_ends_in_words(wired: WireBench, check: WireCheck) -> None:
    await check(wired)


def kept_of(bench: Bench) -> float:
    """OPC UA's server, in this process too, keeps sessions for a while; a closed client of it is 67 objects."""
    return 30.0 if isinstance(bench, OpcUaBench) else 0.5


@pytest.mark.wires
async def test_forty_connections_leave_nothing_behind(bench: Bench) -> None:
    await reconnecting_leaves_nothing_behind(bench, 40, kept=kept_of(bench))


def test_every_driver_of_the_schema_has_a_factory_and_the_reverse() -> None:
    assert set(registry.CNC_DRIVERS) == set(drivers_of(CncConfig))
    for driver, load in registry.CNC_DRIVERS.items():
        assert callable(load()), driver
    assert set(registry.LINES) == {LineConfig.driver} and set(registry.SOURCES) == {*drivers_of(SourceConfig)}
    assert set(registry.FILES) == {DisplacementFileConfig.driver}
    for load_source in (*registry.LINES.values(), *registry.SOURCES.values(), *registry.FILES.values()):
        assert callable(load_source())


def test_every_section_with_a_driver_is_the_one_of_its_name() -> None:
    for driver in drivers_of(CncConfig):
        (section, _) = CncConfig.model_fields[driver].annotation.__args__  # type: ignore[union-attr]
        assert section.driver == driver
    for driver in drivers_of(SourceConfig):
        (section, _) = SourceConfig.model_fields[driver].annotation.__args__  # type: ignore[union-attr]
        assert section.driver == driver


@pytest.mark.parametrize("driver", ["opcua", "focas", "haas", "mtconnect"])
async def test_a_host_that_is_no_address_is_a_lost_link(driver: str) -> None:
    host = "192.168..1"
    sections: dict[str, dict[str, str]] = {"mtconnect": {"url": f"http://{host}:5000"}}
    section = {} if driver == "opcua" else {driver: sections.get(driver, {"host": host})}
    cnc = registry.CNC_DRIVERS[driver]()(cnc_config(f"opc.tcp://{host}:4840/cnc", **section), SystemClock())
    with pytest.raises(LinkError, match=re.escape(f"{host}:")):
        await cnc.connect()
    await cnc.close()
