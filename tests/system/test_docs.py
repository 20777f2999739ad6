"""The documentation names everything there is, and points nowhere in vain."""

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
import yaml
from configuration_keys import walk
from render_commands import commands, commands_reference
from render_configuration import configuration_reference

from config.loader import parse_yaml_model
from config.recordings.recording_map import RecordingMap
from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.plant_store import PlantStoreConfig
from daemon.cli import COMMANDS, main
from daemon.monitor.web.metrics import OF_AXES
from daemon.telemetry.metrics import Telemetry

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]


def page(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


def test_configuration_reference_is_current() -> None:
    assert page("reference/configuration.md") == configuration_reference(), "run `make docs`"


def test_every_configuration_key_is_in_the_reference() -> None:
    text = page("reference/configuration.md")
    for path, knob in walk(Configuration):
        section = ".".join(path[:-1]).replace(".[]", "[]")
        heading = f"## `{section}`" if section else "## Top level"
        assert heading in text
        table = text.split(f"{heading}\n", 1)[1].split("\n## ", 1)[0]
        assert f"| `{knob.name}` |" in table, ".".join(path)


NO_KEYS = re.compile(
    r".*\.(?:der|yaml|py)$|history\.sqlite|output\.fault$|compensation\.z\.|spindle_speed\.target_rpm$"
)
"""Files, tags and keys of the status whose names begin as sections of the configuration do."""


def test_configuration_keys_that_are_named_exist() -> None:
    keys = [[part for part in path if part != "[]" and part[0] != "<"] for path, _ in walk(Configuration)]
    known = {".".join(key[at:]) for key in keys for at in range(len(key))}
    sections = "|".join([*Configuration.model_fields, "output", "reference", "cleansing", "guard", "macros"])
    for path in PAGES:
        if path.name in {"CHANGELOG.md", "upgrade.md"}:  # old names beside the new ones
            continue
        for name in re.findall(rf"`((?:{sections})(?:\.[a-z_0-9]+)+)(?![.\w-])", path.read_text("utf-8")):
            assert name in known or NO_KEYS.match(name), f"{path.name}: {name}"


@pytest.mark.parametrize("guide", ["send-history-to-a-plant", "publish-over-mqtt", "send-alarms", "run-a-plant"])
def test_what_the_guides_of_the_plant_configure_is_taken(guide: str) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", page(f"how-to/{guide}.md"), re.DOTALL)
    assert blocks
    for block in blocks:
        if block.startswith("sinks:"):
            assert parse_yaml_model(f"{sample_configuration()}\n{block}", Configuration, guide).sinks
        else:
            parse_yaml_model(block, PlantStoreConfig, guide)


def test_command_reference_is_current() -> None:
    assert page("reference/commands.md") == commands_reference(), "run `make docs`"


def test_every_command_and_option_is_in_the_reference() -> None:
    text = page("reference/commands.md")
    found = dict(commands(main))
    assert {path[0] for path in found} == set(COMMANDS)
    for path, command in found.items():
        heading = f"## `toolpoint {' '.join(path)}`\n"
        assert heading in text
        part = text.split(heading, 1)[1].split("\n## ", 1)[0]
        assert command.help, f"{' '.join(path)} has no help text"
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.hidden:
                assert all(name in part for name in parameter.opts), (path, parameter.opts)


def test_every_metric_is_in_the_reference() -> None:
    text = page("reference/metrics.md")
    for family in Telemetry().registry.collect():
        assert f"| `{family.name}` |" in text, family.name
    present = {"toolpoint_output_state_number", "toolpoint_temperatures_age_seconds", "toolpoint_temperature_celsius"}
    for name in present | {name for name, _ in OF_AXES.values()}:
        assert f"| `{name}` |" in text, name


def test_every_key_of_a_recording_map_is_in_the_reference() -> None:
    text = page("reference/recording-format.md")
    for name in RecordingMap.model_fields:
        assert f"| `{name}` |" in text, name


def test_the_map_in_the_guide_is_valid() -> None:
    block = page("how-to/train-a-model.md").split("A map of a German", 1)[1].split("## 3.", 1)[0]
    text = "".join(line.removeprefix("    ") for line in block.splitlines(True) if line.startswith("    "))
    assert parse_yaml_model(text, RecordingMap, "guide").temperatures[0] == "Temp Spindel [°C]"


def test_the_fault_script_in_the_tutorial_is_valid() -> None:
    from drivers.sim.faults import FaultKind

    entries = yaml.safe_load(
        "\n".join(re.findall(r"^    (- \{kind: .*\})$", page("tutorial/first-run.md"), re.MULTILINE))
    )
    assert len(entries) == 3
    assert {entry["kind"] for entry in entries} <= {str(kind) for kind in FaultKind}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", path.read_text("utf-8"))
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if not target.startswith("http"):
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_files_and_tests_that_are_named_exist(path: Path) -> None:
    text = path.read_text("utf-8")
    named = re.findall(r"`((?:models|config|drivers|daemon|systemd|docs)/[\w./-]+\.\w+)`", text)
    for file, test in [*re.findall(r"\b(tests/[\w/]+\.py)(?:::(\w+))?", text), *((file, "") for file in named)]:
        assert (ROOT / file).is_file(), file
        assert not test or f"def {test}(" in (ROOT / file).read_text("utf-8"), f"{file}::{test}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_commands_shown_exist(path: Path) -> None:
    known = {" ".join(words): command for words, command in commands(main)}
    text = path.read_text("utf-8")
    shown = re.findall(r"^    (?:sudo (?:-u \w+ )?)?(?:\S*/)?toolpoint ([a-z].*)$", text, re.MULTILINE)
    shown += [line for line in re.findall(r"`toolpoint ([a-z][^`]*)`", text) if " ... " not in line]
    for line in shown:
        words = line.split("  #")[0].split()
        name = " ".join(words[:2]) if " ".join(words[:2]) in known else words[0]
        assert name in known, line
        options = {
            option for parameter in known[name].params for option in (*parameter.opts, *parameter.secondary_opts)
        }
        for word in words:
            if word.startswith("--"):
                assert word in options, f"{name} has no option {word}"


def test_index_leads_to_every_page() -> None:
    text = page("index.md")
    for path in DOCS.rglob("*.md"):
        name = str(path.relative_to(DOCS))
        if name != "index.md" and "decisions" not in path.parts:
            assert f"({name})" in text, name


def test_readme_names_the_two_commands_and_every_folder() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert "make run" in text
    assert "make test" in text
    for folder in ("models", "config", "drivers", "daemon", "systemd", "tests", "docs"):
        assert f"| `{folder}/` |" in text


START_EACH = """
import runpy, sys
path = list(sys.path)
for benchmark in sys.argv[1:]:
    sys.path[:], sys.argv = path, [benchmark, "--help"]
    try:
        runpy.run_path(benchmark, run_name="__main__")
    except SystemExit as end:
        assert not end.code, benchmark
    for name, module in list(sys.modules.items()):
        if "/tests/support/" in str(vars(module).get("__file__")):
            del sys.modules[name]
"""


def test_every_benchmark_is_named_and_starts_by_hand() -> None:
    benchmarks = sorted(map(str, (ROOT / "tests/benchmarks").glob("bench_*.py")))
    text = page("benchmarks.md")
    assert all(f"tests/benchmarks/{Path(each).name}" in text for each in benchmarks)
    done = subprocess.run([sys.executable, "-c", START_EACH, *benchmarks], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.count("usage:") == len(benchmarks), done.stderr


def test_the_changelog_tells_of_this_version_what_a_user_notices() -> None:
    """Several hundred lines of it, each mend of what was never released, told nobody anything."""
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    unreleased = text[text.index("## [Unreleased]") : text.index("## [0.1.0]")]
    assert len(unreleased.encode()) <= 15_000
    headings = re.findall(r"^### .*", unreleased, re.M)
    assert len(headings) == len(set(headings))
