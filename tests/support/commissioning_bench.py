"""A simulated machine that stands at a safe point, its CNC over real OPC UA, and a person in front of it."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from loop_clock import LoopClock
from shipped_machine import shipped_machine

from config.records.commissioning import CommissioningRecord
from config.schema import Configuration
from config.schema.cnc import CncConfig
from config.schema.guard import GuardConfig
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.procedure import Plan
from daemon.commissioning.session import Sources, commission
from daemon.history.reader import HistoryReader
from daemon.history.series import WriteRecord
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import Block, PartProgram, standing_program
from drivers.sim.nc.safe_point import SafePointApplication, simulated_guard
from drivers.sim.nc.wiring import STRAIGHT, Wiring
from drivers.sim.wires.runner import cnc_server
from drivers.sim.wires.tcp_relay import TcpRelay

SPEED = 80.0
FOREVER_S = 600.0
EVER = (0.0, 1e11)
STOPPED = PartProgram(number=9101, blocks=(Block(sequence_number=10, kind="idle", duration_s=3600.0),))
"""Nothing runs: a person calls the guard by hand, or nobody does."""


class Person:
    """Reads the simulated machine's instruments without error, agrees to everything, and calls no guard."""

    def __init__(self, bench: "Bench") -> None:
        self.bench = bench
        self.interactive = True
        self.said: list[str] = []
        self.asked: list[str] = []
        self.denies: str | None = None
        """A question with these words is answered with no."""
        self.eyes: Callable[[str], float | None] = lambda axis: bench.moved_um()[axis]
        self.on_say: Callable[[str], None] = lambda text: None

    @property
    def text_said(self) -> str:
        return "\n".join(self.said)

    def say(self, text: str) -> None:
        self.said.append(text)
        self.on_say(text)

    async def confirm(self, question: str) -> bool:
        self.asked.append(question)
        return self.denies is None or self.denies not in question

    async def confirm_expressly(self, question: str) -> bool:
        return await self.confirm(question)

    async def number(self, question: str) -> float | None:
        self.asked.append(question)
        found = re.search(r"along (\w)", question)
        assert found is not None, question
        return self.eyes(found[1])

    async def text(self, question: str) -> str:
        return "somebody"

    def when_applied(
        self, axis: str, happens: Callable[[], object], *, wait_s: float = 0.0, above_um: float = 4.9
    ) -> None:
        """Let something happen once, when the instrument is read with the offset applied; answer so much later."""
        happened: list[object] = []

        async def number(question: str) -> float | None:
            if self.bench.machine.guard.applied_um[axis] > above_um and not happened:
                happened.append(happens())
            answer = await Person.number(self, question)
            await self.bench.clock.sleep(wait_s if happened else 0.0)
            return answer

        self.number = number  # type: ignore[method-assign]


class PresentNc:
    """The NC of the machine that stands on the bench now, for a server that outlives machines."""

    def __init__(self, bench: "Bench") -> None:
        object.__setattr__(self, "_bench", bench)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bench.machine.nc, name)


class Bench:
    """The machine, and what a commissioning of it needs."""

    def __init__(self, directory: Path, driver: str = "opcua", slope: dict[str, Any] | None = None) -> None:
        """`slope` is the entry `z_slope` of the axes, at a SINUMERIK."""
        self.directory = directory
        self.driver = driver
        """A driver's name, or `sinumerik`: the OPC UA driver at a SINUMERIK."""
        self.clock = LoopClock(SPEED)
        self._described = shipped_machine()
        dialect = "sinumerik" if driver == "sinumerik" else "fanuc"
        if slope is not None:
            content = json.loads(self._described.model_dump_json())
            content["cnc"] |= self._control(0)
            content["cnc"]["guard"] |= {"dialect": dialect, "memory": 600}
            content["cnc"]["macros"]["values"]["z_slope"] = 530
            content["cnc"]["macros"]["echo_applied"]["z_slope"] = 560
            content["compensation"]["axes"] |= {"z_slope": slope}
            content["compensation"]["axes"]["z"]["slew_um_per_min"] = 100.0
            self._described = Configuration.model_validate_json(json.dumps(content))
        self._content = self._described.model_dump_json()
        plain = shipped_machine().compensation.axes
        self.guard = simulated_guard(plain).model_copy(
            update={"dialect": dialect, "memory": self._described.cnc.guard.memory}
        )
        self.stores = 0
        self.reset()
        served = self._described.cnc.model_dump()
        served["macros"]["writable"] += ["121"]  # beyond the shipped map, for the block of the spindle speed
        served |= self._control(0)
        served["guard"]["dialect"] = self.guard.dialect
        config = CncConfig.model_validate(served)
        self.server = cnc_server(PresentNc(self), config, port=0, security=None, readable=())
        self.relay = TcpRelay(port=0, target_port=0)

    def reset(
        self, wiring: Wiring = STRAIGHT, program: PartProgram | None = None, guard: GuardConfig | None = None
    ) -> None:
        """Put a new machine in the old one's place, with a commissioned block at zero, and take a new store."""
        self.wiring = wiring
        self.machine = CfrpMachine(
            Day.draw(7, start="cold"),
            program or standing_program(),
            self._described.temperatures.sensors,
            SafePointApplication(self._described.cnc.macros, self._described.compensation.outputs, guard or self.guard),
            wiring=wiring,
        )
        self._origin_s = self.clock.now().monotonic_s
        self.frozen = False
        self.stores += 1

    def moved_um(self) -> dict[str, float]:
        """What instruments at the tool point would show [um]."""
        return self.wiring.moved_um(self.machine.guard.offsets_um)

    def call_guard(self) -> None:
        """A person calls it in MDI."""
        nc = self.machine.nc
        self.machine.guard.run(nc.macros, nc.clock_at(self.machine.time_s))

    @property
    def clock_s(self) -> float:
        """The clock on which valid_until counts [s]."""
        shown = self.macro(self.guard.shown) if self.driver == "sinumerik" else None
        return self.machine.nc.clock_s if shown is None else shown

    def macro(self, number: int) -> float | None:
        return self.machine.nc.macros.get(number)

    def configuration(self, change: Callable[[dict[str, Any]], None] = lambda content: None) -> Configuration:
        """The published machine on this bench, with slews that a test can wait for."""
        content = json.loads(self._content)
        content["machine"] = "bench <of tests>"
        content["cnc"] |= self._control(self.relay.port)
        content["cnc"]["guard"]["dialect"] = self.guard.dialect
        content["cnc"] |= {"allow_insecure_writes": True, "timeout_s": 5.0, "stale_after_s": 300.0}
        for axis in content["compensation"]["axes"].values():
            axis["slew_um_per_min"] = 100.0
        content["compensation"]["output"] |= {"validity_s": 100.0}
        content["history"] = {"path": str(self.directory / f"{self.stores}.sqlite")}
        content["service"] = {"socket": str(self.directory / "control.sock"), "http_port": None}
        change(content)
        return Configuration.model_validate_json(json.dumps(content))

    def _control(self, port: int) -> dict[str, Any]:
        endpoint = {"endpoint": f"opc.tcp://127.0.0.1:{port}/cnc"}
        if self.driver == "sinumerik":
            return {"driver": "opcua", "opcua": {**endpoint, "preset": "sinumerik"}}
        if self.driver == "opcua":
            return {"driver": "opcua", "opcua": {**endpoint, "namespace_uri": "urn:toolpoint:cnc"}}
        return {"opcua": None, "driver": self.driver, self.driver: {"host": "127.0.0.1", "port": port or 8193}}

    async def commission(
        self,
        person: Person,
        *,
        change: Callable[[dict[str, Any]], None] = lambda content: None,
        sources: Sources | None = None,
        save: Callable[[CommissioningRecord], None] = lambda record: None,
        **plan: Any,
    ) -> CommissioningRecord | None:
        """Commission as the command does."""
        configuration = self.configuration(change)
        content = {
            "axes": tuple(configuration.compensation.axes),
            "offset_um": 5.0,
            "person": "A. Fitter",
            "instrument": "indicator 7",
            "patience_s": 900.0,
        } | plan
        async with asyncio.timeout(FOREVER_S):
            return await commission(configuration, Plan(**content), sources or Sources(), person, self.clock, save=save)

    @property
    def store(self) -> Path:
        return self.directory / f"{self.stores}.sqlite"

    def writes(self) -> list[WriteRecord]:
        """The audit of the latest commissioning."""
        with HistoryReader(self.store) as reader:
            return reader.writes(*EVER)

    def at_rest(self) -> bool:
        """Nothing asked, nothing enabled, nothing applied."""
        macros = self._described.cnc.macros
        asked = [self.macro(number) for number in (*macros.values.values(), macros.enable)]
        applied = self.machine.guard.applied_um.values()
        return all(not value for value in asked) and all(abs(um) < 1e-9 for um in applied)

    async def run(self) -> None:
        """Move the machine on until cancelled."""
        while True:
            if not self.frozen:
                self.machine.advance(self.clock.now().monotonic_s - self._origin_s)
            await self.clock.turn()


@contextlib.asynccontextmanager
async def serving(directory: Path, driver: str = "opcua", slope: dict[str, Any] | None = None) -> AsyncIterator[Bench]:
    """Serve the bench's CNC through a relay that a test can cut."""
    bench = Bench(directory, driver, slope)
    await bench.server.start()
    bench.relay = TcpRelay(port=0, target_port=bench.server.port)
    await bench.relay.start()
    running = asyncio.create_task(bench.run())
    try:
        yield bench
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await bench.relay.stop()
        await bench.server.stop()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served_by_opcua(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Bench]:
    """A bench for all tests of a file, which calls it `served`."""
    async with serving(tmp_path_factory.mktemp("commission")) as bench:
        yield bench


@pytest.fixture
def set_back(served: Bench) -> Bench:
    """The file's `served`, as it was at first."""
    served.reset()
    return served


async def refused(bench: Bench, person: Person | None = None, **changes: Any) -> str:
    """Return the sentence with which a commissioning is refused."""
    with pytest.raises(CommissioningRefusedError) as error:
        await bench.commission(person or Person(bench), **changes)
    return str(error.value)
