"""Machine positions of the axes as each driver reads them: the unit that the control says, and what is no position."""

import contextlib
import math
from collections.abc import AsyncIterator
from typing import Any

import pytest
from scripted_machine import ScriptedNc, cnc_config

from config.schema.cnc import AxisPositionConfig
from config.schema.cnc_drivers import FocasConfig, HaasConfig
from drivers import registry
from drivers.clock import SystemClock
from drivers.contract import Capability
from drivers.focas.codec import Answer, Function, encode_value
from drivers.focas.requests import StateRequest, SystemInfo
from drivers.haas.requests import StateVariables
from drivers.linuxcnc.cnc import LinuxcncCnc
from drivers.mtconnect.device import DataItem, Device
from drivers.sim.wires.runner import cnc_server


def axis(**changes: Any) -> AxisPositionConfig:
    given = {"axis": "Z", "travel_mm": (0.0, 500.0), "rapid_mm_per_min": 30_000.0}
    return AxisPositionConfig(**(given | changes))


@contextlib.asynccontextmanager
async def served(driver: str, axes: dict[str, AxisPositionConfig], **section: Any) -> AsyncIterator[Any]:
    """A control of that kind whose Z stands at 10 (of whatever it counts in), and a connection to it."""
    nc = ScriptedNc()
    nc.positions_mm["Z"] = 10.0
    given: dict[str, Any] = {} if driver == "opcua" else {driver: section or {"host": "127.0.0.1"}}
    server = cnc_server(nc, cnc_config(**given), port=0, security=None, readable=())
    await server.start()
    if driver == "mtconnect":
        given[driver] = section | {"url": server.endpoint}
    elif given:
        given[driver] = {"host": "127.0.0.1", "port": server.port}
    config = cnc_config(f"opc.tcp://127.0.0.1:{server.port}/cnc", axis_positions=axes, timeout_s=5.0, **given)
    cnc = registry.CNC_DRIVERS[driver]()(config, SystemClock())
    await cnc.connect()
    yield cnc, server
    await cnc.close()
    await server.stop()


@pytest.mark.wires
@pytest.mark.parametrize("driver", ["opcua", "focas"])
async def test_a_control_that_counts_in_inches_and_does_not_say_so_is_told_by_the_configuration(driver: str) -> None:
    async with served(driver, {"Z_mm": axis(unit="inch"), "Z": axis()}) as (cnc, _):
        assert (await cnc.read([])).positions_mm == {"Z_mm": 254.0, "Z": 10.0}


def test_a_haas_says_its_unit_and_gives_no_position_while_it_does_not() -> None:
    numbers = {4012: 54.0, 3026: 1.0, 4114: 5.0, 4115: 1000.0, 3027: 0.0}
    for code, expected in ((20.0, 254.0), (21.0, 10.0), (None, math.nan), (0.0, math.nan)):
        state = StateVariables(HaasConfig(host="h"), {"Z_mm": axis(unit="inch")})
        values = numbers | {5023: 10.0, 4006: code}
        assert set(state.numbers) == set(values)
        state.judge(values)
        assert state.positions_mm(values)["Z_mm"] == pytest.approx(expected, nan_ok=True)
        assert (Capability.AXIS_POSITION in state.cannot) == math.isnan(expected)


def test_focas_positions_are_of_the_machine_and_a_vacant_or_refused_one_is_none() -> None:
    request = StateRequest(FocasConfig(host="h"), SystemInfo("x", False), {"Z_mm": axis(), "X_mm": axis(axis="X")})
    asked = next(ask for ask in request.asks() if ask.function == Function.AXIS_POSITION)
    assert asked.arguments == (1, -1), "the machine's coordinates, all axes"
    data = encode_value(12.5) + encode_value(0.0) + encode_value(None)
    found = request._positions_mm(Answer(0, data))
    assert found["X_mm"] == 12.5 and math.isnan(found["Z_mm"]) and not request.cannot.get(Capability.AXIS_POSITION)
    found = request._positions_mm(Answer(0, encode_value(12.5) * 3 + bytes(8 * 29)))
    assert found == {"Z_mm": 12.5, "X_mm": 12.5}, "a control may answer 32 places, of which the last are empty"
    assert math.isnan(request._positions_mm(Answer(-1))["X_mm"]), "busy: for once"
    assert Capability.AXIS_POSITION not in request.cannot
    assert math.isnan(request._positions_mm(Answer(1))["X_mm"])
    assert "does not have this function" in request.cannot[Capability.AXIS_POSITION]
    assert all(ask.function != Function.AXIS_POSITION for ask in request.asks()), "it is not asked again"


def test_linuxcnc_counts_in_the_units_of_its_machine() -> None:
    cnc = LinuxcncCnc(cnc_config(linuxcnc={}, axis_positions={"Z_mm": axis(), "W_mm": axis(axis="W", number=9)}), None)  # type: ignore[arg-type]
    places = [1.0, 2.0, 3.0, *([0.0] * 6)]
    for units_per_mm, expected in ((1.0, 3.0), (1 / 25.4, 76.2), (0.0393700787401575, 76.2), (0.5, math.nan)):
        found = cnc._positions_mm({"position": places, "units_per_mm": units_per_mm, "axes": 0b111})
        assert found["Z_mm"] == pytest.approx(expected, nan_ok=True) and math.isnan(found["W_mm"])
        assert "W" in cnc.cannot[Capability.AXIS_POSITION]


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (DataItem(item_id="z", name="", kind="POSITION", subtype="ACTUAL", unit="INCH"), "not in MILLIMETER"),
        (
            DataItem(item_id="z", name="", kind="POSITION", subtype="ACTUAL", unit="MILLIMETER", coordinates="WORK"),
            "coordinateSystem MACHINE",
        ),
        (
            DataItem(item_id="z", name="", kind="POSITION", subtype="PROGRAMMED", unit="MILLIMETER"),
            "no actual position",
        ),
        (DataItem(item_id="z", name="", kind="POSITION", subtype="TARGET", unit="MILLIMETER"), "no actual position"),
        (DataItem(item_id="z", name="", kind="POSITION", subtype="PROBE", unit="MILLIMETER"), "no actual position"),
        (None, "cnc.mtconnect.position_items"),
    ],
)
def test_a_data_item_that_is_no_machine_position_in_mm_is_none(item: DataItem | None, words: str) -> None:
    run = DataItem(item_id="e", name="", kind="EXECUTION", subtype="")
    items = (run,) if item is None else (run, item)
    device = Device(name="d", uuid="u", items=items, axes={"Z_mm": (axis(), None if item is None else "z")})
    device.values["z"] = "12.5"
    assert words in device.cannot[Capability.AXIS_POSITION] and math.isnan(device.positions_mm()["Z_mm"])


@pytest.mark.wires
async def test_an_agent_s_position_is_read_and_unavailable_is_none() -> None:
    section = {"url": "http://127.0.0.1:1", "position_items": {"Z": "zact"}}
    async with served("mtconnect", {"Z_mm": axis()}, **section) as (cnc, agent):
        assert (await cnc.read([])).positions_mm == {"Z_mm": 10.0}
        agent.available = False
        assert math.isnan((await cnc.read([])).positions_mm["Z_mm"])
