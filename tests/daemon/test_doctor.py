"""What `toolpoint doctor` finds on this computer."""

import importlib.metadata
import subprocess
import sys

import pytest
import yaml
from scripted_machine import ScriptedNc
from speed_machine import speed_machine

from config.loader import load_configuration
from config.machines import shipped_file
from config.sample import sample_configuration
from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig, MtconnectConfig
from config.schema.modbus import ModbusConfig
from config.schema.source_drivers import SourceConfig
from daemon.checkup.computer import OUR_PACKAGES, examine
from daemon.checkup.machine import passing_name, preflight
from drivers.clock import SystemClock
from drivers.sim.wires import mtconnect_agent


def test_the_four_package_names_belong_to_this_project_alone():
    owners = importlib.metadata.packages_distributions()
    for name in OUR_PACKAGES:
        assert set(owners.get(name, ["toolpoint"])) == {"toolpoint"}, name


def test_the_model_of_a_machine_is_looked_at(tmp_path):
    path = tmp_path / "toolpoint.yaml"
    sample = sample_configuration().replace("#model_file: /var/lib/toolpoint-models", f"model_file: {tmp_path}")
    assert f"model_file: {tmp_path}/model.json" in sample
    path.write_text(sample, encoding="utf-8")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert found.pending and not found.passed and "there is no thermal model; release one" in found.detail
    (tmp_path / "model.json").symlink_to(tmp_path / "releases" / "1.json")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert found.failed and "there is no thermal model; release one" in found.detail, "one was there"
    path.write_text(sample.replace(f"{tmp_path}/model.json", f"{tmp_path}/mistyped/model.json"), encoding="utf-8")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert found.failed, "no release can go there"
    path.write_text("machine: [", encoding="utf-8")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert not found.passed and str(path) in found.detail


def test_the_command_prints_what_it_finds():
    finished = subprocess.run(
        [sys.executable, "-P", "-m", "daemon.cli", "doctor"], capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode in (0, 1), finished.stderr
    assert "package names" in finished.stdout and "Traceback" not in finished.stderr


@pytest.mark.parametrize(("macro", "told"), [(None, True), (550, False)])
async def test_of_a_tool_number_that_may_be_the_next_tool_s_it_says_so(tmp_path, macro, told):
    path = tmp_path / "toolpoint.yaml"
    content = yaml.safe_load(shipped_file("cfrpmt.yaml").read_text("utf-8"))
    assert content["compensation"]["axes"]["z"]["tool_term"]
    del content["cnc"]["opcua"]
    focas = {"host": "127.0.0.1"} | ({} if macro is None else {"tool_macro": macro})
    content["cnc"] |= {"driver": "focas", "focas": focas}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    findings = preflight(load_configuration(path), SystemClock(), devices=False)
    details = [finding.detail async for finding in findings if finding.subject == "tool in the spindle"]
    assert ["#4120 is the latest T word" in detail for detail in details] == [True] * told


@pytest.mark.parametrize(("macro", "told"), [(4120, True), (550, False)])
async def test_of_a_speed_that_may_be_the_next_tool_s_it_says_so(tmp_path, macro, told):
    """Call and control both read #4120, so that their comparison finds no tool that is only prepared."""
    configuration = speed_machine(tmp_path)
    cnc = configuration.cnc.model_copy(update={"focas": FocasConfig(host="127.0.0.1", tool_macro=macro)})
    findings = preflight(configuration.model_copy(update={"cnc": cnc}), SystemClock(), devices=False)
    details = [finding.detail async for finding in findings if finding.subject == "tool of the spindle speed"]
    assert ["no speed is tuned until the program has named" in detail for detail in details] == [True] * told


@pytest.mark.parametrize(
    ("memory", "writable", "named"),
    [
        (590, [], ["cnc.guard.memory, #590 is one of #550 to #599, where its probing"]),
        (600, ["150", "799"], ["#150 is one of #150 to #199, which", "#799 is one of #700 to #799, which"]),
        (600, [], []),
    ],
)
async def test_variables_that_a_haas_needs_itself_are_named(memory, writable, named):
    """What its probing system was calibrated to would be overwritten at the first run of the guard."""
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    cnc = configuration.cnc.model_dump(exclude_none=True, exclude={"opcua"})
    cnc["guard"]["memory"], cnc["macros"]["writable"] = memory, [*cnc["macros"]["writable"], *writable]
    for driver in ("haas", "focas"):
        changed = CncConfig.model_validate(cnc | {"driver": driver, driver: {"host": "127.0.0.1"}})
        findings = preflight(configuration.model_copy(update={"cnc": changed}), SystemClock(), devices=False)
        found = [each async for each in findings if "Haas" in each.subject]
        assert [each.passed for each in found] == [not named] * (driver == "haas")
        assert all(each in found[0].detail for each in named if driver == "haas")


async def test_a_line_whose_port_is_missing_is_named_once() -> None:
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    async for finding in preflight(configuration, SystemClock(), devices=True):
        if finding.subject.startswith("line "):
            assert finding.detail.startswith("port ") and not finding.passed
            return
    pytest.fail("no line was tried")


def test_a_port_s_name_that_may_go_to_another_adapter_is_told() -> None:
    """Two lines as long as each other would exchange all their temperatures."""
    line = load_configuration(shipped_file("cfrpmt.yaml")).temperatures.lines[0]
    for port, told in (("/dev/ttyUSB0", True), ("/dev/ttyACM11", True), ("/dev/ttyS0", False), (line.port, False)):
        assert ("by-path" in passing_name(line.model_copy(update={"port": port}))) == told
    box = ModbusConfig(serial_port="/dev/ttyUSB1", sensors=[{"id": 1, "component": "Bed", "address": 0}])
    source = SourceConfig(name="box", driver="modbus", modbus=box)
    assert passing_name(source).startswith("/dev/ttyUSB1 ")


@pytest.mark.wires
async def test_of_a_device_with_several_spindles_it_says_that_no_speed_is_read(monkeypatch) -> None:
    """And that of a control that is looked at only there are no macro variables, not that commissioning makes them."""
    monkeypatch.setitem(mtconnect_agent.ITEMS, "second", mtconnect_agent.ITEMS["speed"])
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    for item in (None, "speed"):
        section = MtconnectConfig(url="http://127.0.0.1:1", spindle_speed_item=item)
        cnc = configuration.cnc.model_copy(update={"driver": "mtconnect", "mtconnect": section})
        agent = mtconnect_agent.SimulatedMtconnectAgent(ScriptedNc(), cnc, port=0)
        await agent.start()
        section = section.model_copy(update={"url": f"http://127.0.0.1:{agent.port}"})
        cnc = cnc.model_copy(update={"mtconnect": section})
        alone = configuration.model_copy(
            update={
                "cnc": cnc,
                "displacements": None,
                "temperatures": configuration.temperatures.model_copy(update={"lines": [], "sources": []}),
            }
        )
        found = [each async for each in preflight(alone, SystemClock(), devices=True)][-1]
        await agent.stop()
        assert found.subject == "cnc" and found.passed, found.detail
        assert "no read macros: an MTConnect agent is read and never written" in found.detail
        told = "no spindle speed: the device has 2 data items of ROTARY_VELOCITY (speed, second): name" in found.detail
        assert told == (item is None), found.detail
