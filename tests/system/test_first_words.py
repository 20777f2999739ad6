"""What somebody meets who has never used the command: the list of commands, a missing file, a fresh sample."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from click.testing import CliRunner, Result

from config.sample import sample_configuration
from daemon.cli import COMMANDS, main


def toolpoint(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], terminal_width=80)


def test_the_list_says_of_every_command_in_one_line_what_it_does() -> None:
    listed = toolpoint("--help").output
    for name, summary in COMMANDS.items():
        assert f"  {name} " in listed and f"{summary}\n" in listed, name
        assert summary.endswith(".")
    assert "..." not in listed.split("Commands:")[1]
    assert all(len(line) <= 80 for line in listed.splitlines())


GROUPS = ("alarm", "cnc", "dynamics", "fleet", "keys", "model", "sink", "sources", "stability", "thermal", "users")


@pytest.mark.parametrize("group", GROUPS)
def test_every_command_in_a_group_is_listed_with_its_whole_sentence(group: str) -> None:
    listed = toolpoint(group, "--help").output.split("Commands:")[1]
    assert "..." not in listed and all(len(line) <= 80 for line in listed.splitlines()), listed
    found = main.get_command(click.Context(main), group)
    assert isinstance(found, click.Group)
    for name, command in found.commands.items():
        sentence = " ".join(str(command.help).split()).partition(". ")[0].removesuffix(".").replace(" ", "")
        assert sentence in "".join(listed.split()), name


@pytest.mark.parametrize("command", ["guard", "check", "run"])
def test_a_missing_configuration_is_answered_with_the_ways_to_name_one(command: str, tmp_path: Path) -> None:
    missing = tmp_path / "toolpoint.yaml"
    found = toolpoint(command, "--config", missing)
    assert found.exit_code == 2
    for word in (f"{missing}: there is no configuration", "--config", "TOOLPOINT_CONFIG", "sample-config"):
        assert word in found.output
    assert ":1:1" not in found.output


def test_the_sample_passes_the_check_and_says_what_is_still_to_come(tmp_path: Path) -> None:
    path = tmp_path / "toolpoint.yaml"
    sample = sample_configuration().replace("/var/lib/toolpoint/", f"{tmp_path}/not-installed/")
    path.write_text(sample, encoding="utf-8")
    found = toolpoint("check", "--no-devices", "--config", path)
    assert found.exit_code == 0, found.output
    assert "FAIL" not in found.output
    assert [line.split("  ")[0].strip() for line in found.output.splitlines()] == ["ok", *["not yet"] * 3]
    findings = json.loads(toolpoint("check", "--no-devices", "--config", path, "--json", "-").output)
    assert [(f["subject"], f["passed"], f["pending"]) for f in findings] == [
        ("thermal model", False, True),
        ("commissioning", False, True),
        ("history", False, True),
    ]


@pytest.mark.parametrize("key", ["model_file", "commissioning_file"])
def test_what_the_configuration_names_and_is_not_there_is_a_failure(key: str, tmp_path: Path) -> None:
    """Of a model that a person is to release, its folder: without that nothing can be released there."""
    content = yaml.safe_load(sample_configuration())
    content["compensation"][key] = str(tmp_path / "mistyped" / "missing.json")
    path = tmp_path / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    found = toolpoint("check", "--no-devices", "--config", path)
    assert found.exit_code == 1 and "FAIL" in found.output and "missing.json" in found.output


def too_coarse(content: dict[str, Any]) -> None:
    """Let the control's increment be larger than the step of an axis: no guard can be written for that."""
    content["cnc"].setdefault("guard", {})["increment_mm"] = 0.01
    content["compensation"]["axes"]["z"].update(step_um=5.0, deadband_um=0.5)


@pytest.mark.parametrize(
    ("change", "words", "status"),
    [
        (lambda content: content["cnc"]["macros"].pop("check"), "cnc.macros.check", 0),
        (lambda content: None, "unencrypted, anonymous connection", 0),
        (too_coarse, "increment", 1),
    ],
    ids=["no check", "insecure", "no text"],
)
def test_what_commissioning_would_refuse_is_said_by_the_check(
    change: Callable[[dict[str, Any]], object], words: str, status: int, tmp_path: Path
) -> None:
    content = yaml.safe_load(sample_configuration())
    change(content)
    path = tmp_path / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    found = toolpoint("check", "--no-devices", "--config", path)
    assert "`toolpoint commission` makes one, but refuses this configuration so far: " in found.output
    assert words in " ".join(found.output.split())
    assert found.exit_code == status


def test_a_record_that_is_named_from_the_current_folder_is_told_by_its_whole_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A path in the configuration starts at the configuration's folder, not at the person's."""
    path = tmp_path / "toolpoint.yaml"
    path.write_text(sample_configuration(), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = toolpoint("commission", "--check", "--config", path, "--record", "trial.json")
    assert found.exit_code == 1 and f"{tmp_path}/elsewhere/trial.json: cannot be read" in found.output


def test_a_full_disk_behind_the_output_is_told_in_a_sentence() -> None:
    command = [sys.executable, "-m", "daemon.cli", "sample-config"]
    with Path("/dev/full").open("wb") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr == "what was written ends in the middle: No space left on device\n"
    ended = subprocess.run(
        [*command[:-1], "doctor", "--json", "/dev/full"], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1 and ended.stderr == "/dev/full ends in the middle: No space left on device\n"


def test_the_live_view_needs_a_terminal_and_says_what_does_not(tmp_path: Path) -> None:
    """It would stay silent in a pipe for ever."""
    found = toolpoint("monitor", "--socket", tmp_path / "control.sock")
    assert found.exit_code == 2 and found.output.splitlines() == [
        "`toolpoint monitor` draws on a terminal, and this is none; `toolpoint status` prints the same once"
    ]


def test_a_back_up_that_is_not_there_is_no_broken_one(tmp_path: Path) -> None:
    found = toolpoint("restore", tmp_path / "x.tar", "--verify")
    assert found.exit_code == 2 and f"File '{tmp_path}/x.tar' does not exist." in found.output
    (tmp_path / "x.tar").write_text("a text", encoding="utf-8")
    found = toolpoint("restore", tmp_path / "x.tar", "--verify")
    assert found.exit_code == 1
    assert found.output == f"{tmp_path}/x.tar: this is no back-up of Toolpoint: it does not begin with manifest.json\n"


@pytest.mark.parametrize("command", [["release", "m.json"], ["rollback"], ["list"], ["list", "--bearings"]])
def test_a_configuration_without_a_place_for_models_is_no_failed_release(command: list[str], tmp_path: Path) -> None:
    assert toolpoint("sample-config", "--output", tmp_path / "own.yaml").exit_code == 0
    found = toolpoint("model", *command, "--config", tmp_path / "own.yaml")
    assert found.exit_code == 2 and "so there is no place for a released" in found.output


def test_streams_that_are_closed_are_open_to_nothing(tmp_path: Path) -> None:
    """Else the next file takes their numbers: a question read from the connection to the CNC."""
    command = [sys.executable, "-m", "daemon.cli", "users", "add", "anna", "--role", "viewer", "--file", tmp_path / "u"]
    closed = subprocess.run(["sh", "-c", 'exec "$@" <&-', "sh", *command], capture_output=True, text=True, check=False)
    assert closed.returncode == 2 and closed.stderr.startswith("standard input is no terminal")
    code = (
        "import os, pathlib, sys; from daemon.cli import main; main(['--version'], standalone_mode=False); "
        "pathlib.Path(sys.argv[1]).write_text(' '.join(os.readlink(f'/proc/self/fd/{n}') for n in range(3)))"
    )
    command = [sys.executable, "-c", code, tmp_path / "open"]
    subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command], check=True)
    assert (tmp_path / "open").read_text() == " ".join([os.devnull] * 3)


def test_a_file_that_cannot_be_used_at_all_is_told_in_a_sentence(tmp_path: Path) -> None:
    """As is one that this account may not look at: root, who may run these tests, may look at all of them."""
    path = tmp_path / "toolpoint.yaml"
    path.write_text(sample_configuration(), encoding="utf-8")
    name = str(tmp_path / ("x" * 300))
    found = toolpoint("backup", name, "--config", path)
    assert found.exit_code == 1 and found.output == f"{name}: File name too long\n"
