"""`toolpoint cnc browse` shows a server's variables and proposes the map of them; it writes nothing."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from scripted_machine import NAMESPACE, ScriptedNc, ScriptedSinumerik, cnc_config

from config.machines import shipped_file
from config.schema.cnc_drivers import OpcUaConfig, OpcUaNodesConfig
from daemon.checkup.node_map import propose
from daemon.cli import main
from daemon.simulation.processes import write_simulation_configuration
from drivers.opcua.browsing import Browsed, Variable
from drivers.opcua.variables import FANUC_NODES
from drivers.sim.wires.opcua_server import SimulatedCncServer


def shown(*variables: tuple[str, str, Any], namespace: str = "urn:a") -> Browsed:
    """A server that shows these variables: node, path, value."""
    found = tuple(Variable(namespace=namespace, node=node, path=path, value=value) for node, path, value in variables)
    return Browsed(namespaces=("http://opcfoundation.org/UA/", namespace), variables=found, complete=True)


OTHERS = (
    ("i=10", "CNC/Op Mode", 1),
    ("i=11", "CNC/RunStatus", 3),
    ("i=12", "CNC/Alarm_Active", False),
    ("i=13", "CNC/Program Number", 1000),
    ("i=14", "CNC/Spindle/ActualSpindleSpeed", 1.5),
    ("i=15", "CNC/Spindle/Spindle_Speed", 2.5),
    ("s=Vars.Common[500]", "Vars/500", 0.0),
    ("s=Vars.Common[501]", "Vars/501", 0.0),
    ("s=Other.Macro100", "Other/Macro100", 0.0),
)


def test_variables_of_another_server_are_known_by_their_usual_names() -> None:
    proposal = propose(shown(*OTHERS))
    assert proposal is not None and (proposal.preset, proposal.namespace) == ("generic", "urn:a")
    assert proposal.nodes == {
        "mode": "i=10",
        "run": "i=11",
        "alarm": "i=12",
        "program": "i=13",
        "spindle_speed": "i=15",
        "macro": "s=Vars.Common[{number}]",
    }
    assert proposal.others == {"spindle_speed": ("i=14",), "macro": ("s=Other.Macro{number}",)}
    assert set(proposal.missing) == set(FANUC_NODES) - set(proposal.nodes) - {"axis_position"}, "which nobody must have"
    section = proposal.section("opc.tcp://here:4840")
    assert section["nodes"]["clock"] == "none", "said, and the output stays refused"
    assert OpcUaConfig.model_validate(section).namespace == "urn:a"


def test_a_text_is_proposed_where_it_is_read_and_nowhere_else() -> None:
    texts = (("i=20", "CNC/Program", "O1000"), ("i=21", "CNC/WorkOffset", "G54"), ("i=22", "CNC/Clock", "12:30:00"))
    proposal = propose(shown(*texts, ("i=23", "CNC/Tool/Tool_No", "T3"), ("i=24", "CNC/Mode", "AUTO")))
    assert proposal is not None
    assert proposal.nodes == {"program": "i=20", "work_offset": "i=21", "tool_number": "i=23"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "name the server"),
        (("http://here",), "name the server"),
        (("opc.tcp://here:1", "-c", str(shipped_file("cfrpmt.yaml"))), "and not both"),
        (("opc.tcp://127.0.0.1:1/x",), "was lost while connecting: nothing listens there: check address and port"),
        (("opc.tcp://127.0.0.1:1/x", "--timeout-s", "nan"), "nan is not a finite number"),
    ],
)
def test_what_cannot_be_browsed_is_refused_with_what_to_do(arguments: tuple[str, ...], words: str) -> None:
    done = CliRunner().invoke(main, ["cnc", "browse", *arguments])
    assert done.exit_code in (1, 2) and words in done.output


async def browsed(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "daemon.cli", "cnc", "browse", *arguments]
    return await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, check=False)


@pytest.mark.wires
async def test_a_fanuc_needs_its_namespace_alone_and_the_proposal_is_what_is_configured(tmp_path: Path) -> None:
    nc = ScriptedNc()
    server = SimulatedCncServer(nc, cnc_config(), port=0)
    await server.start()
    done = await browsed(server.endpoint, "--json", "-")
    found = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert found["proposal"] == {"endpoint": server.endpoint, "preset": "fanuc", "namespace_uri": NAMESPACE}
    assert found["missing"] == [] and found["complete"] and found["values"]["tool_number"] == 3
    assert {"s=Mode", "s=Macro.500"} <= {each["node"] for each in found["variables"]}
    printed = await browsed(server.endpoint)
    assert yaml.safe_load(printed.stdout)["cnc"]["opcua"] == found["proposal"], "comments and YAML to paste"
    assert nc.macros.written == []
    await server.stop()


@pytest.mark.wires
async def test_a_sinumerik_is_recognised_and_its_parameters_read_though_they_cannot_be_browsed(tmp_path: Path) -> None:
    nc = ScriptedSinumerik()
    server = SimulatedCncServer(nc, cnc_config(preset="sinumerik", namespace_uri=None), port=0, readable=[])
    await server.start()
    content = yaml.safe_load(shipped_file("cfrpmt.yaml").read_text(encoding="utf-8"))
    path, _ = write_simulation_configuration(content, tmp_path, speed=1.0, driver="sinumerik")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["cnc"]["opcua"]["endpoint"] = server.endpoint
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    done = await browsed("-c", str(path), "--json", "-")
    found = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert found["proposal"]["preset"] == "sinumerik" and "namespace_uri" not in found["proposal"]
    assert found["values"]["clock"] > 100.0 and found["values"]["work_offset"] == "G54"
    assert not any("/R[" in each["node"] for each in found["variables"])
    await server.stop()


@pytest.mark.wires
async def test_the_proposal_of_a_generic_server_is_a_configuration_that_reads_it() -> None:
    nodes = OpcUaNodesConfig(**{key: FANUC_NODES[key] for key in ("mode", "run", "alarm")}, macro="s=Variable.{number}")
    server = SimulatedCncServer(ScriptedNc(), cnc_config(preset="generic", nodes=nodes), port=0)
    await server.start()
    found = json.loads((await browsed(server.endpoint, "--json", "-")).stdout)
    section = found["proposal"]
    assert (section["preset"], section["nodes"]["macro"]) == ("generic", "s=Variable.{number}")
    assert set(found["missing"]) == set(FANUC_NODES) - {"mode", "run", "alarm", "macro", "axis_position"}
    assert OpcUaConfig.model_validate(section).nodes.clock == "none"  # type: ignore[union-attr]
    await server.stop()
