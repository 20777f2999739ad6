"""The commands without a daemon; with one: `test_on_wires.py`."""

import pytest
from click.testing import CliRunner

from config.sample import sample_configuration
from daemon.cli import main


@pytest.mark.parametrize("command", ["status", "enable", "disable", "reference", "acknowledge"])
def test_without_a_daemon_every_command_says_so(tmp_path, command):
    finished = CliRunner().invoke(main, [command, "--socket", str(tmp_path / "nobody")])
    assert finished.exit_code == 1 and "is it running" in finished.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--headles"),
        ("demo", "--headless", "--minutes", "-3"),
        ("nonsense",),
        ("run", "--simulated-clock", "now"),
        ("disable", "--zero", "z", "--socket", "/nonexistent"),
    ],
)
def test_bad_usage_ends_with_2(arguments):
    finished = CliRunner().invoke(main, arguments)
    assert finished.exit_code == 2 and isinstance(finished.exception, SystemExit)
    assert finished.stderr and finished.stdout == ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("cycle_period_s: ", "cycle_periode_s: "), ("cycle_periode_s", "unknown")),
        (("absolute_bound_um: ", "absolute_bound_um: much #"), ("absolute_bound_um",)),
        (("machine:", "machine: [\nx:"), ()),
    ],
)
def test_a_broken_configuration_names_file_line_column_and_key(tmp_path, change, words):
    text = sample_configuration()
    assert change[0] in text
    path = tmp_path / "broken.yaml"
    path.write_text(text.replace(*change, 1), encoding="utf-8")
    line = text[: text.index(change[0])].count("\n") + 1
    for command in ("run", "check"):
        finished = CliRunner().invoke(main, [command, "--config", str(path)])
        assert finished.exit_code == 2 and isinstance(finished.exception, SystemExit)
        assert str(path) in finished.stderr
        if words:
            assert f"{path}:{line}:" in finished.stderr
        for word in words:
            assert word in finished.stderr.lower(), finished.stderr
