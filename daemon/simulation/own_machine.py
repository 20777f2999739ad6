"""A configuration on the simulated machine: its sensors, its axes and its CNC driver, before a cable is laid.

Sensors sit where their component's words say, or somewhere for ever the same. Wires, reference and safe points are
those of the simulated machine; a model is trained on simulated days with these very sensors.
"""

import json
import math
import zlib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from config.loader import load_configuration
from config.records.commissioning import CommissionedAxis, CommissionedSlope, CommissioningRecord, macro_map_digest
from config.schema import Configuration
from config.schema.modbus import ModbusConfig
from config.schema.source_drivers import SourceConfig
from config.schema.source_sections import CsvConfig, MqttConfig, ProcessConfig
from config.schema.sources import SourceSensorConfig
from daemon.simulation import SimulationError
from daemon.simulation.processes import free_port, write_simulation_configuration
from daemon.simulation.simulated_model import CHANNELS, simulated_recording, training_programmes
from daemon.workbench.thermal.training import write_model_file
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.guard.text import GUARD_VERSION
from drivers.sim.machine.sensors import COMPONENTS
from drivers.sim.machine.travel import axis_travels
from drivers.sim.wires.pushed_wires import follows
from drivers.sim.wires.source_wires import as_simulated, face_of
from models.recordings.slopes import SLOPE_SUFFIX
from models.thermal.training.increment_family import IncrementChoices
from models.thermal.training.recipes import RECIPES, increment_recipe
from models.thermal.training.train_family import train_family

TRAINING_SEEDS = (1, 2, 3, 4)
HOURS = 6.0
INTERVAL_MIN = 10.0
OF_AXIS = {"y": "Y1", "z": "Z1"}
"""Channel of the simulated machine that an axis follows; X moves by less than 5 um."""
WORDS = (
    ("Ambient", ("ambient", "air", "room", "hall", "umgebung", "raum", "luft", "halle")),
    ("Cooling circuit of chiller", ("cool", "chiller", "oil", "water", "kühl", "öl", "wasser")),
    ("Spindle unit", ("spindle", "head", "ram", "quill", "nose", "spindel", "pinole")),
    ("Column", ("column", "portal", "gantry", "post", "ständer", "säule")),
    ("X-axis slider", ("slide", "x-axis", "x axis", "schlitten")),
    ("Saddle", ("saddle", "y-axis", "y axis", "cross", "sattel")),
    ("Trunnion table", ("table", "trunnion", "rotary", "pallet", "tisch", "schwenk")),
    ("Bed", ("bed", "base", "frame", "foundation", "bett", "gestell")),
)
"""Component of the simulated machine -> words in a foreign one's name, the first that fits."""
SIMULATED_WIRES = ("opcua", "focas", "haas", "mtconnect")
"""Drivers for which there is a simulated control."""
LEFT_OUT = {
    **dict.fromkeys(("displacements", "spindle_speed", "signatures"), ""),
    **dict.fromkeys(("opcua_server", "shdr"), ": others would take what is simulated for the machine"),
    "sinks": ": what is simulated would stand among the plant's; `toolpoint fleet simulate` tries servers",
}
"""Section -> why, for people."""
COMMON = ("id", "label", "unit", "scale", "offset", "open", "min_degc", "max_degc")


def placed(component: str) -> str:
    """Return the component of the simulated machine that stands for another machine's."""
    if component in COMPONENTS:
        return component
    text = component.lower()
    found = next((name for name, words in WORDS if any(word in text for word in words)), None)
    structure = [name for name, _ in WORDS if name not in ("Ambient", "Cooling circuit of chiller")]
    return found or structure[zlib.crc32(text.encode()) % len(structure)]


def prepare(path: Path, directory: Path, *, speed: float, http_port: int | None, say: Callable[[str], None]) -> Path:
    """Write such a simulation's configuration, model and record into a folder; return the configuration's path."""
    configuration = load_configuration(path)
    base = yaml.safe_load(path.read_text(encoding="utf-8"))
    base["machine"] = f"simulated {configuration.machine}"
    for section, why in LEFT_OUT.items():
        if base.pop(section, None):
            say(f"{section}: left out{why}")
    _move_sensors(base, configuration, directory, say)
    driver: str = configuration.cnc.driver
    if configuration.cnc.is_sinumerik:
        driver = "sinumerik"
    elif driver not in SIMULATED_WIRES:
        say(f"cnc: a simulated control that speaks OPC UA stands for {driver}; that wire is not tried")
        driver = "opcua"
    elif driver == "mtconnect":
        say("cnc: an MTConnect agent is only read, so nothing can be enabled and nothing is written")
    compensation = base["compensation"]
    compensation["reference"] = {"sequence_numbers": [100]}
    compensation.setdefault("output", {})["safe_sequence_numbers"] = [900]
    for key in ("commissioning_file", "model_file", "retraining"):
        compensation.pop(key, None)
    for name, axis in compensation["axes"].items():
        axis.pop("tool_term", None)
        if axis.get("slope"):
            continue
        if axis.get("estimate") and name not in OF_AXIS:
            axis.pop("estimate")
            say(f"axis {name}: the simulated machine has nothing to estimate there")
        elif axis.get("estimate") and axis["estimate"] not in CHANNELS:
            say(f"axis {name}: {axis['estimate']} is the simulated machine's {OF_AXIS[name]}")
            axis["estimate"] = OF_AXIS[name]
    _follow_slopes(compensation["axes"], say)
    say("reference and safe points are the simulated part program's N100 and N900")
    written, moved = write_simulation_configuration(base, directory, speed=speed, http_port=http_port, driver=driver)
    _commission(moved, directory / "commissioning.json")
    say("training a model on simulated days with these sensors")
    _train(moved, directory / "model.json")
    content = yaml.safe_load(written.read_text(encoding="utf-8"))
    content["compensation"] |= {
        "model_file": str(directory / "model.json"),
        "commissioning_file": str(directory / "commissioning.json"),
    }
    written.write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
    load_configuration(written)
    return written


def _follow_slopes(axes: dict[str, dict[str, Any]], say: Callable[[str], None]) -> None:
    """Let slopes follow what the simulated scale of their axis grows."""
    for name, axis in ((name, axis) for name, axis in axes.items() if axis.get("slope") and axis.get("estimate")):
        slope = axis["slope"]
        if (of := axes[slope["of"]].get("estimate")) is None:
            axis.pop("estimate")
            say(f"axis {name}: the simulated machine has nothing to estimate along {slope['of']}")
            continue
        axis["estimate"] = of + SLOPE_SUFFIX
        lowest, highest = slope["travel_mm"]
        say(
            f"axis {name}: {slope['of']} goes from {lowest:g} to {highest:g} mm, to another place with every cut, and "
            f"its scale grows; the model tells that as {axis['estimate']}"
        )


def _move_sensors(
    base: dict[str, Any], configuration: Configuration, directory: Path, say: Callable[[str], None]
) -> None:
    temperatures = base["temperatures"]
    temperatures.setdefault("lines", [])
    for sensor in temperatures.get("sensors", []):
        _place(sensor, sensor["component"], say)
    sources = configuration.temperatures.sources or ()
    if sources:
        temperatures["sources"] = [_on_its_wire(source, directory, say) or _box(source, say) for source in sources]


def _place(sensor: dict[str, Any], component: str, say: Callable[[str], None]) -> None:
    sensor["component"] = placed(component)
    if sensor["component"] != component:
        say(f"sensor {sensor['id']}: {component} is the simulated machine's {sensor['component']}")


def _on_its_wire(source: SourceConfig, directory: Path, say: Callable[[str], None]) -> dict[str, Any] | None:
    """Return the source as it is, at what stands here for its broker, file or program; None where nothing can."""
    config = source.connection
    described: dict[str, Any] = json.loads(config.model_dump_json(exclude_none=True))
    if isinstance(config, MqttConfig):
        moved = {"host": "127.0.0.1", "port": free_port(), "sensors": described["sensors"]}
        words = "a broker of this computer, without TLS and user"
    elif isinstance(config, CsvConfig):
        moved = described
        name = config.file.path.name
        moved["file"] |= {"path": str(directory / source.name / name), "encoding": "utf-8"}
        words = f"files in {directory / source.name}"
    elif isinstance(config, ProcessConfig):
        moved = described | {"command": follows(directory / f"{source.name}.jsonl")}
        words = f"`{' '.join(moved['command'])}`"
    else:
        return None
    entry = {"name": source.name, "driver": source.driver, "cycle_period_s": source.cycle_period_s}
    entry[source.driver] = moved
    try:
        face_of(SourceConfig.model_validate_json(json.dumps(entry)), lambda ids: [math.nan] * len(ids))
    except ValueError:
        return None
    for sensor in moved["sensors"]:
        _place(sensor, sensor["component"], say)
    say(f"source {source.name}: {words} instead")
    return entry


def _box(source: SourceConfig, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the source as a simulated Modbus box: its own registers, or one number after the other."""
    config = source.connection
    box: dict[str, Any] = {"host": "127.0.0.1", "port": free_port()}
    sensors = []
    for place, sensor in enumerate(source.sensors):
        if isinstance(config, ModbusConfig):
            described = json.loads(config.sensors[place].model_dump_json())
        else:
            described = _common(sensor) | {"address": 2 * place, "type": "float32"}
        _place(described, sensor.component, say)
        sensors.append(described)
    if isinstance(config, ModbusConfig):
        box |= {key: getattr(config, key) for key in ("unit_id", "gap", "most_registers")}
        box["framing"] = "rtu" if config.is_rtu else "tcp"
    else:
        say(f"source {source.name}: a simulated Modbus box stands for {source.driver}; that wire is not tried")
    return {
        "name": source.name,
        "driver": "modbus",
        "cycle_period_s": source.cycle_period_s,
        "modbus": box | {"sensors": sensors},
    }


def _common(sensor: SourceSensorConfig) -> dict[str, Any]:
    return {key: getattr(sensor, key) for key in COMMON} | {"component": sensor.component, "part": sensor.part}


def _commission(configuration: Configuration, path: Path) -> None:
    axis = CommissionedAxis(sign=1, scale=1.0, written_um=10.0, measured_um=10.0)
    proved = {
        name: CommissionedSlope(of=slope.of, pivot_mm=slope.pivot_mm, positions_mm=slope.travel_mm)
        for name, slope in configuration.compensation.slopes.items()
    }
    record = CommissioningRecord(
        cnc_identity=SIMULATED_CNC_IDENTITY,
        macro_map_sha256=macro_map_digest(configuration.cnc.macros),
        guard_version=GUARD_VERSION,
        person="simulation (the simulated machine's sign is known by construction)",
        date=datetime.now(UTC).date().isoformat(),
        machine=configuration.machine,
        axes={name: axis.model_copy(update={"slope": proved.get(name)}) for name in configuration.compensation.axes},
    )
    path.write_text(record.model_dump_json(exclude_none=True), encoding="utf-8")


def _train(configuration: Configuration, path: Path) -> None:
    sensors = [as_simulated(sensor) for sensor in configuration.temperatures.every_sensor]
    programmes, compensation = training_programmes(), configuration.compensation
    slopes = {
        channel: slope.pivot_mm
        for slope in compensation.slopes.values()
        if (channel := compensation.axes[slope.of].estimate) is not None
    }
    travels = axis_travels(configuration) if slopes else None
    try:
        recordings = [
            simulated_recording(
                seed, programmes[place % len(programmes)], sensors, hours=HOURS, travels=travels, slopes=slopes
            )
            for place, seed in enumerate(TRAINING_SEEDS)
        ]
        choices = IncrementChoices(interval_min=INTERVAL_MIN, ridge_k2="auto", split_at_speed_changes=False)
        recipe = RECIPES["ridge"] if slopes else increment_recipe(choices)  # a slope is told by passes of minutes
        created = datetime.now(UTC).isoformat(timespec="seconds")
        model = train_family(recordings, recipe, sample_s=60.0, created=created, machine=configuration.machine).model
    except ValueError as error:
        raise SimulationError(f"no model can be trained on these sensors: {error}") from error
    write_model_file(model, path)
