"""What the schema itself refuses, and at which key it says so."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from render_configuration import configuration_reference

from config.loader import ConfigurationError, load_with_warnings, parse_yaml_model
from config.sample import sample_configuration
from config.schema import Configuration
from drivers.guard.programs import guard_program
from drivers.guard.text import GuardTextError

_SAMPLE = yaml.safe_load(sample_configuration())


def sample() -> dict[str, Any]:
    """Return the content of the sample, for a test to change."""
    content: dict[str, Any] = deepcopy(_SAMPLE)
    return content


def changed(path: str, value: Any) -> str:
    """Return the sample with the value at a dotted path changed; numbers are list indices."""
    content = sample()
    target: Any = content
    *parents, last = path.split(".")
    for step in parents:
        target = target[int(step)] if step.isdigit() else target.setdefault(step, {})
    target[int(last) if last.isdigit() else last] = value
    return yaml.safe_dump(content, sort_keys=False)


SENSOR = {"component": "Column"}
FILE = {"path": "x.csv", "header": "time"}
BOX_SENSORS: list[dict[str, Any]] = [{"id": 9, "component": "Bed", "address": 0}]
BOX: dict[str, Any] = {"name": "box", "driver": "modbus", "modbus": {"host": "x", "sensors": BOX_SENSORS}}
CHANNEL = {"name": "Z1", "column": "Z1"}
SEVEN_AXES = {letter: {"letter": letter, "number": number} for number, letter in enumerate("XYZUVWA", start=1)}


@pytest.mark.parametrize(
    ("path", "value", "key", "sentence"),
    [
        (
            "cnc.temperature_macro",
            {"sensor": 1, "macro": 600},
            "cnc.temperature_macro.macro",
            "#600 lies outside `macros.writable`",
        ),
        ("cnc.temperature_macro", {"sensor": 1, "macro": 500}, "cnc.temperature_macro.macro", "#500 belongs to"),
        (
            "cnc.temperature_macro",
            {"sensor": 99, "macro": 549},
            "cnc.temperature_macro.sensor",
            "there is no sensor 99",
        ),
        ("temperatures.lines.0.chain", ["4-1"], "temperatures.lines[0].chain", "the range 4-1 runs backwards"),
        ("temperatures.lines.0.chain", ["1-201"], "temperatures.lines[0].chain", "at most 200 sensors"),
        ("temperatures.lines.0.chain", ["1-999999999"], "temperatures.lines[0].chain", "more than 100000 numbers"),
        ("temperatures.lines.0.chain", ["1-4", 2], "temperatures.lines[0].chain", "two chain positions: [2]"),
        ("temperatures.lines.0.chain", ["1-5"], "temperatures.lines[0].chain", "not listed: [5]"),
        ("temperatures.lines.0.chain", ["1-3"], "temperatures.sensors[3].id", "sensor 4 hangs on no chain"),
        ("temperatures.lines.0.id_offset", 4092, "temperatures.lines[0].chain", "highest ID on the wire would be 4096"),
        ("temperatures.sources", [BOX, BOX], "temperatures.sources[1].name", "two sources have the same name 'box'"),
        (
            "temperatures.sources",
            [BOX, BOX],
            "temperatures.sources[1].modbus.sensors[0].id",
            "sensor 9 is listed twice",
        ),
        (
            "temperatures.sources",
            [{**BOX, "name": "spindle"}],
            "temperatures.sources[0].name",
            "two inputs have the same",
        ),
        ("temperatures.sources", [{**BOX, "driver": "modbuss"}], "temperatures.sources[0].driver", "must be"),
        ("temperatures.sources", [{**BOX, "modbus": None}], "temperatures.sources[0].modbus", "required and missing"),
        (
            "temperatures.sources",
            [{**BOX, "modbus": {"serial_port": "/dev/ttyUSB9", "sensors": BOX_SENSORS}}] * 2,
            "temperatures.sources[1].modbus.sensors[0].id",
            "listed twice",
        ),
        (
            "temperatures.sources",
            [{**BOX, "modbus": {"host": "x", "sensors": [{**BOX_SENSORS[0], "max_degc": 150.0}]}}],
            "temperatures.sources[0].modbus.sensors[0].max_degc",
            "above cleansing.max_degc (100)",
        ),
        (
            "temperatures.sources",
            [{**BOX, "modbus": {"host": "x", "sensors": [{**BOX_SENSORS[0], "min_degc": -50.0}]}}],
            "temperatures.sources[0].modbus.sensors[0].min_degc",
            "below cleansing.min_degc (-20)",
        ),
        (
            "temperatures.sources",
            [{**BOX, "modbus": {"host": "x", "sensors": [{**BOX_SENSORS[0], "id": 2_603_150_001}]}}],
            "temperatures.sources[0].modbus.sensors[0].id",
            "at most 99999999",  # beyond 32 bit no sink of the plant takes a row of its source
        ),
        ("temperatures.sensors.0.id", 2_603_150_001, "temperatures.sensors[0].id", "at most 99999999"),
        ("temperatures.lines.0.grammar", {}, "temperatures.lines[0].grammar", "only then"),
        ("temperatures.lines.0.profile", "custom", "temperatures.lines[0].profile", "give `grammar`"),
        ("temperatures.sensors.1", {"id": 1, **SENSOR}, "temperatures.sensors[1].id", "sensor 1 is listed twice"),
        ("temperatures.sensors.0.label", "a b", "temperatures.sensors[0].label", "letters from A to Z, digits"),
        ("temperatures.cleansing.min_degc", 200.0, "temperatures.cleansing.min_degc", "below max_degc"),
        ("displacements", {"file": FILE, "channels": [CHANNEL, CHANNEL]}, "displacements.channels[1].name", "same"),
        (
            "displacements",
            {"file": {"path": "x"}, "channels": [CHANNEL]},
            "displacements.channels[0].column",
            "columns must be given by number",
        ),
        (
            "displacements",
            {"file": {**FILE, "time_columns": [0]}, "channels": [CHANNEL]},
            "displacements.file.time_columns",
            "columns count from 1",  # 0 would be the last one
        ),
        (
            "displacements",
            {"file": {**FILE, "time_zone": "Mars/Base"}, "channels": [CHANNEL]},
            "displacements.file.time_zone",
            "no time zone 'Mars/Base'",
        ),
        (
            "displacements",
            {"file": {**FILE, "time_format": "%Q"}, "channels": [CHANNEL]},
            "displacements.file.time_format",
            "no strptime format",
        ),
        (
            "displacements",
            {"file": {**FILE, "start": "today", "interval_s": 60.0}, "channels": [CHANNEL]},
            "displacements.file.start",
            "no ISO 8601 time",
        ),
        (
            "displacements",
            {"file": {**FILE, "start": "x"}, "channels": [CHANNEL]},
            "displacements.file.start",
            "start and interval_s go together",
        ),
        (
            "displacements",
            {"file": {**FILE, "decimal": ","}, "channels": [CHANNEL]},
            "displacements.file.decimal",
            "the same character",
        ),
        (
            "displacements",
            {"file": FILE, "channels": [{**CHANNEL, "scale_um": 0.0}]},
            "displacements.channels[0].scale_um",
            "must not be 0",
        ),
        ("cnc.opcua.endpoint", "http://x", "cnc.opcua.endpoint", "an address such as opc.tcp://"),
        ("cnc.opcua.nodes.macro", "s=Macro", "cnc.opcua.nodes.macro", "must contain {number}"),
        ("cnc.stale_after_s", 0.5, "cnc.stale_after_s", "longer than poll_period_s"),
        ("cnc.macros.values.z", 120, "cnc.macros.values.z", "#120 is used twice: it is valid_until already"),
        ("cnc.macros.enable", 600, "cnc.macros.enable", "#600 lies outside `writable` (120-121, 500-549)"),
        ("cnc.macros.valid_until", 520, "cnc.macros.valid_until", "one of #100-#199"),
        ("cnc.macros.echo_applied", {"y": 520}, "cnc.macros.echo_applied", "the same axes as `values`"),
        ("cnc.macros.writable", ["500 to 549"], "cnc.macros.writable[0]", "such as 120 or 500-549"),
        ("cnc.macros.writable", [500.5], "cnc.macros.writable[0]", "must be text"),
        ("compensation.axes", {}, "compensation.axes", "filled in"),
        ("compensation.axes.z.estimate", "Z1 ", "compensation.axes.z.estimate", "text on one line"),
        ("compensation.axes.z.deadband_um", 50.0, "compensation.axes.z.deadband_um", "nothing is ever written"),
        ("compensation.output.validity_s", 1.0, "compensation.output.validity_s", "expires between two ticks"),
        ("compensation.output.validity_s", 120.0, "compensation.output.validity_s", "the guard accepts none"),
        ("compensation.output.validity_s", 119.5, "compensation.output.validity_s", "for up to 120 s"),
        ("cnc.guard", {"max_validity_s": 30.0}, "compensation.output.validity_s", "cnc.guard.max_validity_s"),
        (
            "compensation.reference.sequence_numbers",
            [100, 90010],
            "compensation.reference.sequence_numbers[1]",
            "N90000 to N90999 occur in the guard",
        ),
        (
            "compensation.reference.retreat_sequence_numbers",
            [90200],
            "compensation.reference.retreat_sequence_numbers[0]",
            "choose another number",
        ),
        (
            "compensation.output.safe_sequence_numbers",
            [90900],
            "compensation.output.safe_sequence_numbers[0]",
            "choose another number",
        ),
        ("compensation.output.alarm_after_s", 5.0, "compensation.output.alarm_after_s", "must hold"),
        ("service.retry_min_s", 60.0, "service.retry_min_s", "not be longer than retry_max_s"),
        ("service.socket", "/run/" + "x" * 110, "service.socket", "at most 107 bytes"),
        ("service.http_port", 70000, "service.http_port", "at most 65535"),
        ("machine", "mill\t 7", "machine", "text on one line"),
        ("cnc.poll_period_s", 1e-320, "cnc.poll_period_s", "at least 0.001"),
        ("cnc.poll_period_s", 1e308, "cnc.poll_period_s", "at most 31536000"),
        ("history.keep_writes_days", 1e308, "history.keep_writes_days", "at most 36500"),
        ("machine", "m" * 201, "machine", "at most 200 characters"),
        ("cnc.guard.axes", {"z": {"letter": "B", "number": 4}}, "cnc.guard.axes.z.letter", "B turns: 1 um"),
        ("cnc.guard.axes", SEVEN_AXES, "cnc.guard.axes.A.letter", "A turns: 1 um"),
    ],
)
def test_what_cannot_work_is_refused_at_its_key(path: str, value: Any, key: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(changed(path, value), Configuration, "f.yaml")
    assert any(problem.key == key and sentence in problem.sentence for problem in refused.value.problems), str(
        refused.value
    )


def test_sources_stand_beside_lines_or_instead_of_them() -> None:
    beside = parse_yaml_model(changed("temperatures.sources", [BOX]), Configuration, "f.yaml").temperatures
    assert [each.name for each in beside.inputs] == ["spindle", "box"]
    assert beside.sensor_ids == (1, 2, 3, 4, 9)
    content = yaml.safe_load(changed("temperatures.sources", [BOX]))
    del content["temperatures"]["lines"], content["temperatures"]["sensors"]
    instead = parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml").temperatures
    assert instead.sensor_ids == (9,) and instead.components == ("Bed",)
    del content["temperatures"]["sources"]
    with pytest.raises(ConfigurationError, match=r"temperatures\.lines: there is nothing to read"):
        parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")


def test_a_serial_port_has_one_reader() -> None:
    box = {**BOX, "modbus": {"serial_port": "/dev/ttyUSB9", "sensors": BOX_SENSORS}}
    other = {**box, "name": "other", "modbus": {**box["modbus"], "sensors": [{**BOX_SENSORS[0], "id": 10}]}}
    with pytest.raises(ConfigurationError, match="box uses /dev/ttyUSB9 already") as refused:
        parse_yaml_model(changed("temperatures.sources", [box, other]), Configuration, "f.yaml")
    (problem,) = refused.value.problems
    assert problem.key == "temperatures.sources[1].modbus.serial_port"
    content = yaml.safe_load(changed("temperatures.sources", [box]))
    content["temperatures"]["lines"][0]["port"] = "/dev/ttyUSB9"
    with pytest.raises(ConfigurationError, match="spindle uses /dev/ttyUSB9 already"):
        parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")


GAUGES: dict[str, Any] = {
    "name": "gauges",
    "driver": "modbus",
    "modbus": {"host": "x", "channels": [{"name": "Z1", "address": 0, "unit": "mm", "scale": 0.0001}]},
}


@pytest.mark.parametrize(
    ("value", "key", "sentence"),
    [
        ({}, ".file", "there is nothing to read"),
        ({"channels": [CHANNEL]}, ".file", "file and channels go together"),
        ({"file": FILE, "sources": [GAUGES]}, ".channels", "file and channels go together"),
        (
            {"file": FILE, "channels": [CHANNEL], "sources": [GAUGES]},
            ".sources[0].modbus.channels[0].name",
            "two channels have the same name 'Z1'",
        ),
        ({"sources": [{**GAUGES, "name": "spindle"}]}, ".sources[0].name", "temperatures come from spindle already"),
        (
            {"sources": [{**GAUGES, "modbus": {"host": "x", "channels": [{"name": "A", "axis": "q", "address": 0}]}}]},
            ".sources[0].modbus.channels[0].axis",
            "there is no axis q; there are z",
        ),
        (
            {"sources": [{**GAUGES, "modbus": {"host": "x", "channels": [{"name": "A", "scale": 0.0, "address": 0}]}}]},
            ".sources[0].modbus.channels[0].scale",
            "must not be 0",
        ),
    ],
)
def test_displacement_sources_that_cannot_work(value: dict[str, Any], key: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(changed("displacements", value), Configuration, "f.yaml")
    named = [problem for problem in refused.value.problems if problem.key == f"displacements{key}"]
    assert named and sentence in named[0].sentence, refused.value.problems


def test_channels_of_a_source_stand_behind_those_of_the_file_and_their_port_is_theirs() -> None:
    other = {**GAUGES["modbus"]["channels"][0], "name": "Z9"}
    gauges = {**GAUGES, "modbus": {"host": "x", "channels": [other]}}
    text = changed("displacements", {"file": FILE, "channels": [CHANNEL], "sources": [gauges]})
    found = parse_yaml_model(text, Configuration, "f.yaml").displacements
    assert found is not None
    assert [channel.name for channel in found.every_channel] == ["Z1", "Z9"]
    assert found.every_channel[1].value(-15.0) == pytest.approx(-1.5)  # type: ignore[union-attr]
    box = {**BOX, "modbus": {"serial_port": "/dev/ttyUSB9", "sensors": BOX_SENSORS}}
    content = yaml.safe_load(changed("temperatures.sources", [box]))
    content["displacements"] = {"sources": [{**gauges, "modbus": {"serial_port": "/dev/ttyUSB9", "channels": [other]}}]}
    with pytest.raises(ConfigurationError, match="box uses /dev/ttyUSB9 already"):
        parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")


TOOL = {"length_mm": 100.0, "temperatures": {"Nose": 1.0}}


@pytest.mark.parametrize(
    ("change", "key", "sentence"),
    [
        ({"temperatures": {"Nose": 0.4, "Room": 0.5}}, ".temperatures", "they sum to 0.9"),
        ({"temperatures": {"Nowhere": 1.0}}, ".temperatures", "no sensor carries the label ['Nowhere']"),
        ({"direction": 0}, ".direction", "+1 or -1"),
        ({"length_mm": -1.0}, ".length_mm", "must be above 0, not -1.0"),
    ],
)
def test_tool_terms_that_cannot_work(change: dict[str, Any], key: str, sentence: str) -> None:
    text = changed("compensation.axes.z.tool_term", {**TOOL, **change})
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, Configuration, "f.yaml")
    (problem,) = refused.value.problems
    assert problem.key == f"compensation.axes.z.tool_term{key}"
    assert sentence in problem.sentence


@pytest.mark.parametrize(
    ("tool_macro", "handshake", "told"), [(None, False, True), (None, True, False), (550, False, False)]
)
def test_a_tool_term_needs_a_tool_that_is_named_where_the_control_tells_the_latest_t_word_alone(
    tool_macro: int | None, handshake: bool, told: bool
) -> None:
    content = sample()
    content["compensation"]["axes"]["z"]["tool_term"] = TOOL
    content["cnc"] |= {
        "driver": "focas",
        "focas": {"host": "10.0.0.2"} | ({} if tool_macro is None else {"tool_macro": tool_macro}),
    }
    del content["cnc"]["opcua"]
    content["cnc"]["macros"].pop("request", None)
    if handshake:
        content["cnc"]["macros"]["writable"].append("524")
        content["cnc"]["macros"]["request"] = {
            "counter": 520,
            "kind": 521,
            "axis": 522,
            "value_mm": 523,
            "acknowledge": 524,
        }
    text = yaml.safe_dump(content)
    if not told:
        parse_yaml_model(text, Configuration, "f.yaml")
        return
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, Configuration, "f.yaml")
    assert [problem.key for problem in refused.value.problems] == ["compensation.axes.z.tool_term"]
    assert "#4120 is the latest T word" in str(refused.value) and "cnc.macros.request" in str(refused.value)


def test_limits_that_move_the_machine_have_no_default() -> None:
    content = sample()
    content["compensation"]["axes"]["z"] = {"estimate": "Z1"}
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml")
    missing = {problem.key.rsplit(".")[-1] for problem in refused.value.problems}
    assert missing == {"absolute_bound_um", "slew_um_per_min", "step_um"}


def test_a_block_without_a_check_is_told_with_what_to_add(tmp_path: Path) -> None:
    content = sample()
    del content["cnc"]["macros"]["check"]
    path = tmp_path / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    configuration, warnings = load_with_warnings(path)
    assert [warning.key for warning in warnings] == ["cnc.macros.check"]
    assert "no axis is enabled: name one within `cnc.macros.writable`" in warnings[0].sentence
    with pytest.raises(GuardTextError, match=r"cnc\.macros\.check names no variable"):
        guard_program(configuration)


def test_reference_page_names_every_section() -> None:
    page = configuration_reference()
    for heading in ("## `temperatures.lines[].grammar`", "## `compensation.axes.<name>.tool_term`", "## `service`"):
        assert heading in page


def test_a_range_of_sensors_stands_for_each_of_them_and_problems_name_the_written_line() -> None:
    content = sample()
    shared = {"id": "5-7", "component": "Bed", "part": "Left"}
    content["temperatures"]["sensors"][3:3] = [shared]
    content["temperatures"]["lines"][0]["chain"] = ["1-7"]
    text = yaml.safe_dump(content, sort_keys=False)
    sensors = parse_yaml_model(text, Configuration, "f.yaml").temperatures.sensors
    assert [sensor.id for sensor in sensors] == [1, 2, 3, 5, 6, 7, 4]
    assert {sensor.part for sensor in sensors[3:6]} == {"Left"}

    content["temperatures"]["sensors"][4]["id"] = 0
    text = yaml.safe_dump(content, sort_keys=False)
    line = next(n for n, row in enumerate(text.splitlines(), 1) if row.strip() == "- id: 0")
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, Configuration, "f.yaml")
    assert f"f.yaml:{line}:" in str(refused.value) and "this must be at least 1, not 0" in str(refused.value)


@pytest.mark.parametrize(
    ("written", "sentence"),
    [
        ("7-5", "the range 7-5 runs backwards; write 5-7"),
        ("1-99999", "the range 1-99999 holds more than the 200 sensors of a line"),
        ("5 to 7", "this must be a whole number, not the text '5 to 7'"),
    ],
)
def test_a_range_that_is_none_is_refused_in_words(written: str, sentence: str) -> None:
    text = changed("temperatures.sensors.0.id", written)
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, Configuration, "f.yaml")
    assert sentence in str(refused.value)


def test_the_step_of_a_sensor_is_that_of_its_device_its_register_or_what_sends_it_in_kelvin() -> None:
    registers = [
        {"id": 6, "component": "Bed", "address": 0, "scale": 0.1},
        {"id": 7, "component": "Bed", "address": 1, "scale": 0.1, "unit": "degF"},
        {"id": 8, "component": "Bed", "address": 2, "type": "float32"},
        {"id": 9, "component": "Bed", "address": 4, "type": "float32", "unit": "degF", "resolution": 0.9},
        {"id": 10, "component": "Bed", "address": 6, "scale": 0.1, "resolution": 1.0},
    ]
    source = {**BOX, "modbus": {"host": "x", "sensors": registers}}
    content = yaml.safe_load(changed("temperatures.sources", [source]))
    content["temperatures"]["sensors"][0]["device"] = "MLX90615"
    steps_k = parse_yaml_model(yaml.safe_dump(content), Configuration, "f.yaml").temperatures.steps_k
    expected = {1: 0.02, 2: 0.0625, 3: 0.0625, 4: 0.0625, 6: 0.1, 7: 0.1 / 1.8, 8: 0.0, 9: 0.5, 10: 1.0}
    assert steps_k == pytest.approx(expected)
