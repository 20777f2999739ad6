"""`toolpoint cnc probe` says who the control is and what it gives, and writes nothing."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from scripted_machine import ScriptedNc, cnc_config

from config.machines import shipped_file
from daemon.simulation.processes import write_simulation_configuration
from drivers.contract import SIMULATED_CNC_IDENTITY, Capability
from drivers.sim.wires.focas_server import SimulatedFocasServer

pytestmark = pytest.mark.wires


def configured(directory: Path, port: int, *, allowed: bool) -> Path:
    content = yaml.safe_load(shipped_file("cfrpmt.yaml").read_text(encoding="utf-8"))
    path, _ = write_simulation_configuration(content, directory, speed=1.0, driver="focas")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["cnc"] |= {"focas": {"host": "127.0.0.1", "port": port}, "allow_insecure_writes": allowed}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


async def probed(path: Path) -> tuple[int, dict[str, Any]]:
    command = [sys.executable, "-P", "-m", "daemon.cli", "cnc", "probe", "-c", str(path), "--json", "-"]
    done = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, check=False)
    return done.returncode, json.loads(done.stdout)


async def test_a_control_says_what_it_gives_and_the_daemon_what_it_would_refuse(tmp_path: Path) -> None:
    nc = ScriptedNc()
    server = SimulatedFocasServer(nc, cnc_config(focas={"host": "127.0.0.1"}), port=0)
    await server.start()
    for allowed in (True, False):
        status, found = await probed(configured(tmp_path, server.port, allowed=allowed))
        assert (status, found["driver"], found["identity"]) == (0, "focas", SIMULATED_CNC_IDENTITY)
        assert found["secure"] is False and nc.macros.written == []
        assert set(found["can"]) == set(Capability) and found["can"]["sequence_number"]
        assert found["can"]["write_macros"] is allowed
        refused = {entry["what"]: entry["why"] for entry in found["refused"]}
        assert refused["axis_position"] == "cnc.axis_positions names no axis to read"
        assert set(refused) == {"motor_temperature", "axis_position"} | (set() if allowed else {"write_macros"})
        assert allowed or "set cnc.allow_insecure_writes: true" in refused["write_macros"]
    await server.stop()
    status, found = await probed(configured(tmp_path, server.port, allowed=True))
    assert (status, found["identity"], any(found["can"].values())) == (1, None, False)
    assert found["refused"][0]["what"] == "connect" and "refuses the connection" in found["refused"][0]["why"]
