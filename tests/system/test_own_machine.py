"""`toolpoint simulate` on a stranger's configuration: any components, any source, another control."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from pace import bearable
from sloped_machine import PIVOT_MM, TRAVEL_MM
from sloped_machine import content as sloped_content

from config.loader import load_configuration
from config.machines import shipped_file
from config.records.commissioning import load_commissioning
from daemon.cli import main
from daemon.model_release.gate import machine_inhibit, unfit
from daemon.model_release.loading import read_model
from daemon.simulation import own_machine
from daemon.simulation.own_machine import placed
from daemon.simulation.simulation import simulated_day
from drivers.clock import SystemClock
from drivers.sim.machine.machine import CfrpMachine
from models.thermal.estimation import Machine, OnlineReference


def stranger(path: Path) -> Path:
    """A box of PT100s, a program, a broker and a logger, components that nobody knows, and a FANUC over Ethernet."""
    content = yaml.safe_load(shipped_file("pt100.yaml").read_text(encoding="utf-8"))
    box = content["temperatures"]["sources"][0]
    box["modbus"]["sensors"][3]["component"] = "Portal left"
    program = {
        "name": "logger",
        "driver": "process",
        "process": {
            "command": ["/usr/local/bin/read-my-logger"],
            "sensors": [{"id": 21, "component": "Quill", "field": "t1", "unit": "degF"}],
        },
    }
    broker = {
        "name": "broker",
        "driver": "mqtt",
        "mqtt": {
            "host": "192.0.2.2",
            "tls": True,
            "sensors": [{"id": 31, "component": "Bett", "topic": "hall/bed", "field": "a.b", "scale": 0.1}],
        },
    }
    files = {"path": "/srv/logger/*.csv", "delimiter": ";", "decimal": ",", "header": "Zeit", "time_columns": ["Zeit"]}
    logger = {
        "name": "files",
        "driver": "csv",
        "csv": {
            "file": {**files, "time_format": "%d.%m.%Y %H:%M:%S", "time_zone": "Europe/Berlin"},
            "sensors": [{"id": 41, "component": "Ständer", "column": "T1"}],
        },
    }
    content["temperatures"]["sources"] += [program, broker, logger]
    content["cnc"] |= {"driver": "focas", "focas": {"host": "192.168.10.20"}}
    del content["cnc"]["opcua"]
    content["compensation"]["axes"]["z"]["estimate"] = "Weg Z"
    content["shdr"] = {"port": 7878}
    content["sinks"] = [{"name": "plant", "driver": "postgresql", "postgresql": {"host": "192.0.2.1"}}]
    content["opcua_server"] = {
        "certificate": "/pki/c.der",
        "private_key": "/pki/k.pem",
        "trusted_clients": "/pki/clients",
    }
    content.setdefault("service", {})["users"] = "/etc/toolpoint/users"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def sloped(path: Path) -> Path:
    """A SINUMERIK whose Z takes a slope and tells where it stands, with a box of twelve sensors on one line."""
    content = sloped_content(path.parent)
    components = ["Spindle unit"] * 4 + ["Column", "Slider", "Saddle"] * 2 + ["Bed", "Room"]
    content["temperatures"] = {
        "lines": [{"name": "box", "port": "/dev/ttyUSB0", "chain": ["1-12"]}],
        "sensors": [{"id": n, "device": "TMP102", "component": name} for n, name in enumerate(components, start=1)],
    }
    content["cnc"]["axis_positions"] = {
        "Z_mm": {"axis": "Z", "travel_mm": list(TRAVEL_MM), "rapid_mm_per_min": 30000.0}
    }
    axes = content["compensation"]["axes"]
    axes["z"]["estimate"], axes["z_slope"]["estimate"] = "Weg Z", "Weg Z_per_m"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(content))), encoding="utf-8")
    return path


def test_components_of_any_name_have_a_place_that_stays() -> None:
    assert placed("Spindle unit") == "Spindle unit"
    assert placed("Portal left") == "Column" and placed("Quill") == "Spindle unit" and placed("Raumluft") == "Ambient"
    assert placed("Querbalken 7") == placed("Querbalken 7")


@pytest.mark.wires
@pytest.mark.slow
def test_a_strangers_machine_comes_to_a_verified_write(tmp_path: Path) -> None:
    path = stranger(tmp_path / "mine.yaml")
    command = ["simulate", "--config", str(path), "--minutes", "25", "--enable", "--json", "-"]
    for speed in (bearable(60.0), 15.0):  # what else runs may begin after the pace was measured
        options = ["--speed", f"{speed:.1f}", "--directory", str(tmp_path / "folder")]
        done = CliRunner().invoke(main, [*command, *options])
        if done.exit_code == 0 or "this computer is too slow" not in done.output:
            break
        shutil.rmtree(tmp_path / "folder")
    assert done.exit_code == 0, done.output
    assert "sensor 4: Portal left is the simulated machine's Column" in done.output
    for words in ("logger: `tail -n +1 -F", "broker: a broker of this computer", "files: files in"):
        assert f"source {words}" in done.output
    assert "axis z: Weg Z is the simulated machine's Z1" in done.output
    numbers = json.loads(done.stdout)
    assert numbers["estimates"] > 0 and numbers["cycles"]["incomplete"] == 0
    assert numbers["writes"]["verified"] == numbers["writes"]["sent"] > 0
    assert numbers["error_um"]["z"]["verdict"] == "passed"
    written = yaml.safe_load((tmp_path / "folder" / "toolpoint.yaml").read_text(encoding="utf-8"))
    assert written["cnc"]["driver"] == "focas"
    for section in ("shdr", "opcua_server", "sinks"):
        assert f"{section}: left out" in done.output and section not in written


def test_a_slope_gets_its_record_and_a_model_of_simulated_days_that_tells_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_machine, "TRAINING_SEEDS", (1, 2))
    said: list[str] = []
    (tmp_path / "folder").mkdir()
    path = sloped(tmp_path / "mine.yaml")
    written = own_machine.prepare(path, tmp_path / "folder", speed=60.0, http_port=None, say=said.append)
    words = (
        "axis z_slope: z goes from 0 to 500 mm, to another place with every cut, and its scale grows; the model tells"
    )
    assert any(words in each for each in said)
    configuration = load_configuration(written)
    record = load_commissioning(configuration.compensation.commissioning_file or Path())
    assert record.axes["z_slope"].slope is not None and record.axes["z"].slope is None
    model, why = read_model(
        configuration.compensation.model_file or Path(), configuration.temperatures.sensor_ids, ["Z1", "Z1_per_m"]
    )
    assert model is not None and unfit(model, configuration) == "", why
    assert machine_inhibit(model, configuration) == ""
    assert "trained on machine 'simulated sloped'" in machine_inhibit(model, load_configuration(path))
    machine = simulated_day(configuration, SystemClock(), None).machine  # type: ignore[arg-type]
    assert isinstance(machine, CfrpMachine)
    online = model.runtime(Machine(components=dict.fromkeys(configuration.temperatures.sensor_ids, "all")))
    travel, none, left = machine.body.travel, np.zeros(12, dtype=np.bool_), []
    for minute in range(3, 45):
        machine.advance(60.0 * minute)
        degc, nodes = machine.body.sensors.degc(machine.body.register_codes()), machine.body.thermal_nodes()
        online.on_sample(float(minute), degc, 0.0)
        if minute == 3:
            begun = nodes
            online.set_reference(OnlineReference(time_min=3.0, now_min=3.0, degc=degc))
        estimation, _ = online.estimate(float(minute), degc, none)
        assert estimation is not None
        grown_um = [travel.grown_um(each, machine.time_s)[2] for each in (nodes, begun)]
        along_m = 1e-3 * (machine.nc.positions_mm["Z"] - PIVOT_MM)
        true_um = grown_um[0] - grown_um[1]
        left.append((true_um, true_um - along_m * estimation.thermal_error_um[model.channels.index("Z1_per_m")]))
    without, with_slope = np.sqrt(np.mean(np.square(left), axis=0))
    print(f"{without:.2f} um along the axis without its slope, {with_slope:.2f} um with it")
    assert without > 1.0 and with_slope < 0.6 * without
