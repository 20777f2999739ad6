"""The printed sample, the JSON Schema and the commands that print them."""

import json
import re
import resource
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
import yaml
from click.testing import CliRunner
from configuration_keys import walk

from config.loader import parse_yaml_model
from config.machines import machine_names, shipped_file
from config.sample import configuration_json_schema, sample_configuration
from config.schema import Configuration
from config.schema.base import drivers_of
from config.schema.cnc import CncConfig
from config.schema.sinks import SinkConfig
from config.schema.source_drivers import SourceConfig
from daemon.cli import main

NOT_IN_USE = re.compile(r"^(\s*)#(?! \S)(?=\s*\S)", re.MULTILINE)


def everything_in_use() -> str:
    """Return the sample with all keys in use, blocks inside blocks too; one driver, as they exclude each other."""
    text = sample_configuration().split("\n\n", 1)[1]
    before = ""
    while before != text:
        before, text = text, NOT_IN_USE.sub(r"\1", text)
    for driver in drivers_of(CncConfig)[1:]:
        text = re.sub(rf"^  {driver}:\n(?:    .*\n)*", "", text, flags=re.MULTILINE)
    for driver in drivers_of(SourceConfig)[1:]:
        text = re.sub(rf"^      {driver}:\n(?:        .*\n)*", "", text, flags=re.MULTILINE)
    for driver in drivers_of(SinkConfig)[1:]:
        text = re.sub(rf"^    {driver}:\n(?:      .*\n)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^( +)serial_port: .*\n", "", text, flags=re.MULTILINE)  # instead of `host`
    text = re.sub(r"^      slope:\n(?:        .*\n)*", "", text, flags=re.MULTILINE)  # of an entry that is no offset
    return text.replace("profile: checked", "profile: custom")


def test_sample_is_valid_as_it_stands() -> None:
    configuration = parse_yaml_model(sample_configuration(), Configuration, "sample")
    assert configuration.displacements is None
    assert not configuration.cnc.connection.encrypted
    assert configuration.compensation.model_file is None


def test_sample_is_valid_with_everything_in_use() -> None:
    configuration = parse_yaml_model(everything_in_use(), Configuration, "sample")
    assert configuration.displacements is not None
    assert configuration.cnc.connection.encrypted
    assert configuration.temperatures.lines[0].grammar is not None
    assert configuration.compensation.axes["z"].tool_term is not None


def test_sample_holds_every_key_with_its_meaning() -> None:
    sample = sample_configuration()
    flat = re.sub(r"\s*\n[\s#]*# (?!\()", " ", sample)
    for path, knob in walk(Configuration):
        assert re.search(rf"^[\s#-]*{knob.name}:", sample, re.MULTILINE), path
        assert knob.description, f"{'.'.join(path)} has no description"
        assert knob.description in re.sub(r"\s+", " ", flat), path


def test_sample_shows_the_defaults() -> None:
    configuration = parse_yaml_model(sample_configuration(), Configuration, "sample")
    for path, knob in walk(Configuration):
        if knob.section or knob.required or knob.default is None or {"[]", "<name>"} & set(path):
            continue
        value: object = configuration
        for step in path:
            value = getattr(value, step, None)
            if value is None:
                break  # inside a section that is not in use
        else:
            assert value == knob.default, path


def test_json_schema_accepts_what_the_loader_accepts() -> None:
    schema = configuration_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    for text in (sample_configuration(), everything_in_use(), shipped_file("cfrpmt.yaml").read_text("utf-8")):
        validator.validate(yaml.safe_load(text))
    broken = yaml.safe_load(sample_configuration())
    broken["cnc"]["maccros"] = {}
    broken["compensation"]["axes"]["z"]["step_um"] = -1
    assert {error.json_path for error in validator.iter_errors(broken)} == {"$.cnc", "$.compensation.axes.z.step_um"}


def test_commands_print_sample_machine_and_schema(tmp_path: Path) -> None:
    runner = CliRunner()
    printed = runner.invoke(main, ["sample-config"])
    assert (printed.exit_code, printed.output) == (0, sample_configuration())
    for name in machine_names():
        machine = runner.invoke(main, ["sample-config", "--machine", name])
        assert machine.output == shipped_file(f"{name}.yaml").read_text("utf-8")
    unknown = runner.invoke(main, ["sample-config", "--machine", "../../etc/passwd"])
    assert unknown.exit_code == 2
    assert "no machine '../../etc/passwd' ships with Toolpoint; there are cfrpmt" in unknown.output
    schema = runner.invoke(main, ["config-schema"])
    assert json.loads(schema.output) == configuration_json_schema()


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "toolpoint.yaml"
    runner = CliRunner()
    assert runner.invoke(main, ["sample-config", "--output", str(target)]).exit_code == 0
    assert target.read_text("utf-8") == sample_configuration()
    target.write_text("mine")
    again = runner.invoke(main, ["sample-config", "--output", str(target)])
    assert again.exit_code == 2
    assert "exists already" in again.output
    assert target.read_text() == "mine"


@pytest.mark.parametrize("command", ["sample-config", "guard"])
def test_a_file_that_the_disk_has_no_room_for_is_not_left_half(tmp_path: Path, command: str) -> None:
    """Half a guard program could be loaded into a control."""
    path, target = tmp_path / "toolpoint.yaml", tmp_path / "new"
    path.write_text(sample_configuration(), encoding="utf-8")
    words = [command, "--output", str(target), *(["--config", str(path)] if command == "guard" else [])]
    ended = subprocess.run(
        [sys.executable, "-m", "daemon.cli", *words],
        check=False,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024)),
    )
    assert ended.returncode == 2 and ended.stderr == f"{target} cannot be written: File too large\n"
    assert not target.exists()
