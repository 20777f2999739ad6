"""`toolpoint simulate` on a stranger's configuration: any components, any source, another control."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from config.machines import shipped_file
from daemon.cli import main
from daemon.simulation.own_machine import placed


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


def test_components_of_any_name_have_a_place_that_stays() -> None:
    assert placed("Spindle unit") == "Spindle unit"
    assert placed("Portal left") == "Column" and placed("Quill") == "Spindle unit" and placed("Raumluft") == "Ambient"
    assert placed("Querbalken 7") == placed("Querbalken 7")


@pytest.mark.wires
@pytest.mark.slow
def test_a_strangers_machine_comes_to_a_verified_write(tmp_path: Path) -> None:
    path = stranger(tmp_path / "mine.yaml")
    command = ["simulate", "--config", str(path), "--minutes", "45", "--enable", "--json", "-"]
    done = CliRunner().invoke(main, [*command, "--directory", str(tmp_path / "folder")])
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
