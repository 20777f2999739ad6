"""A configuration by which a sensor reads something else: what the daemon knows of its past is of another sensor."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import machine
from rewired import EXCHANGED, rewired
from twin_loop import Place, TwinLoop
from whole_loop import lagged_model

from config.schema.temperatures import TemperaturesConfig
from models.control.state import OperatorRequest
from models.records import OutputState
from models.thermal.linear import LinearModel

pytestmark = pytest.mark.quiet

PLACE = Place(rise_k=np.array([9.0, 2.0, 7.0, 2.0, 3.0]), constant_s=np.full(5, 2500.0))
WEIGHTS = np.outer(np.outer([3.0, 0.6, -3.6], [1.0, 0.1, 0.3, 0.1, 0.1]), [0.6, 1.0])
"""Of a model to which a lag of the first sensor is worth as much as its temperature [um/K]."""


def ahead_of_lags() -> LinearModel:
    model = lagged_model("long", lags_min=(1.0, 20.0))
    (vector,), (solution,) = model.test_vectors, model.solutions
    expected_um = (vector.features - vector.reference) @ WEIGHTS
    vector = replace(vector, thermal_error_um=expected_um)
    return replace(model, solutions=(replace(solution, weights=WEIGHTS),), test_vectors=(vector,))


class SetRight(TwinLoop):
    """The configuration takes two sensors for each other until a person sets it right and starts the daemon again."""

    exchanged = False
    away_s = 0.0

    def begin(self, *, exchanged: bool, away_s: float) -> "SetRight":
        self.exchanged, self.away_s = exchanged, away_s
        self._wire(EXCHANGED if exchanged else ["1-3"])
        return self

    def _wire(self, chain: list[int | str]) -> None:
        self.loop.configuration = rewired(self.loop.configuration, chain)
        self._listen()

    async def _pause(self) -> None:
        self.loop.clock.monotonic_s += self.away_s
        self._wire(["1-3"])
        await super()._pause()

    async def _program(self) -> None:
        await super()._program()
        if self.moment - self.before == 12:
            self.loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")


def stopped_once(kind: type[SetRight], folder: Path) -> SetRight:
    """Return a loop with a long past whose daemon ends once, in the tenth moment, and starts again."""
    return kind(
        folder,
        ahead_of_lags(),
        PLACE,
        "checked",
        before=600,
        reads_past=True,
        pauses=(10,),
        restarting=True,
        positionings=(30,),
    )


@pytest.mark.parametrize("away_s", [0.0, 700.0], ids=["at once", "after a longer outage"])
def test_an_edited_configuration_leaves_nothing_of_another_sensor_in_the_lags(tmp_path: Path, away_s: float) -> None:
    loops = []
    for exchanged in (False, True):
        loop = stopped_once(SetRight, tmp_path / str(exchanged))
        asyncio.run(loop.begin(exchanged=exchanged, away_s=away_s).run(240))
        loops.append(loop)
    twin, loop = loops
    off_um = np.array(loop.applied_um) - np.array(twin.applied_um)
    followed = np.array([state is OutputState.ACTIVE for state in loop.states])[40:]
    assert followed.all() or away_s > 0.0
    assert np.abs(off_um[40:][followed]).max(initial=0.0) <= 1.0


class Renamed(SetRight):
    """The store is another machine's: its computer was copied, and the name in the configuration changed."""

    def _wire(self, chain: list[int | str]) -> None:
        super()._wire(chain)
        if hasattr(self, "moment"):
            self.loop.configuration = self.loop.configuration.model_copy(update={"machine": "its sister"})


def test_the_history_of_another_machine_fills_no_lags(tmp_path: Path) -> None:
    """Where all of the past is another's, too little is known until the lags have filled anew."""
    loop = stopped_once(Renamed, tmp_path / "loop")
    asyncio.run(loop.begin(exchanged=False, away_s=0.0).run(60))
    assert loop.states[9] is OutputState.ACTIVE and loop.states[-1] is OutputState.HOLD
    assert "too little is known" in loop.loop.rig.control.memory.reason


@pytest.mark.parametrize(
    ("changes", "anew"),
    [
        ({"label": "B", "component": "table", "part": "left"}, False),
        ({"min_degc": 0.0, "max_degc": 70.0, "open": [999.9], "resolution": 0.5}, False),
        ({"scale": 0.1}, True),
        ({"offset": -1.5}, True),
        ({"unit": "degF"}, True),
        ({"address": 7}, True),
    ],
)
def test_what_a_sensor_is_called_is_not_what_it_reads(changes: dict[str, Any], anew: bool) -> None:
    sensor = {"id": 9, "component": "bed", "address": 3}
    boxes = [
        {"driver": "modbus", "modbus": {"host": "192.168.10.30", "sensors": [sensor | more]}} for more in ({}, changes)
    ]
    before, after = (TemperaturesConfig.model_validate({"sources": [box | {"name": "box"}]}).reads for box in boxes)
    assert (before != after) == anew


@pytest.mark.parametrize(
    ("changes", "anew"),
    [
        ({"timeout_s": 3.0, "gap": 9, "framing": "rtu", "baud": 19200, "parity": "even"}, False),
        ({"host": "192.168.10.31"}, True),
        ({"unit_id": 4}, True),
    ],
)
def test_how_long_a_box_is_waited_for_is_not_what_it_reads(changes: dict[str, Any], anew: bool) -> None:
    sensors = [{"id": 9, "component": "bed", "address": 3}]
    wires = [{"host": "192.168.10.30", "sensors": sensors} | more for more in ({}, changes)]
    before, after = (
        TemperaturesConfig.model_validate({"sources": [{"name": "box", "driver": "modbus", "modbus": wire}]}).reads
        for wire in wires
    )
    assert (before != after) == anew


def test_two_lines_whose_ports_were_exchanged_read_each_others_sensors(tmp_path: Path) -> None:
    before = machine(tmp_path).temperatures
    ports = [line.port for line in reversed(before.lines)]
    lines = [line.model_copy(update={"port": port}) for line, port in zip(before.lines, ports, strict=True)]
    after = TemperaturesConfig(lines=lines, sensors=before.sensors, cleansing=before.cleansing)
    assert not set(before.reads.items()) & set(after.reads.items())


@pytest.mark.parametrize(
    ("changes", "anew"),
    [({"overflow_tokens": ["OL"], "poll_period_s": 2.0}, False), ({"path": Path("/srv/another/*.csv")}, True)],
)
def test_how_a_logger_writes_that_it_has_no_value_is_not_what_it_reads(changes: dict[str, Any], anew: bool) -> None:
    sensors = [{"id": 9, "component": "bed", "column": 2}]
    files = [{"path": Path("/srv/logger/*.csv")} | more for more in ({}, changes)]
    before, after = (
        TemperaturesConfig.model_validate(
            {"sources": [{"name": "logger", "driver": "csv", "csv": {"file": file, "sensors": sensors}}]}
        ).reads
        for file in files
    )
    assert (before != after) == anew
