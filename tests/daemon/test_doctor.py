"""What `toolpoint doctor` finds on this computer."""

import importlib.metadata
import subprocess
import sys

import pytest

from config.loader import load_configuration
from config.machines import shipped_file
from config.sample import sample_configuration
from daemon.checkup.computer import OUR_PACKAGES, examine
from daemon.checkup.machine import Finding, preflight
from daemon.cli.common import show_finding
from drivers.clock import SystemClock


def test_this_environment_is_healthy():
    findings = {finding.subject: finding for finding in examine()}
    for subject in ("python", "packages", "package names", "sqlite", "clock"):
        assert findings[subject].passed, findings[subject].detail
    assert sys.version.split()[0] in findings["python"].detail


def test_the_four_package_names_belong_to_this_project_alone():
    owners = importlib.metadata.packages_distributions()
    for name in OUR_PACKAGES:
        assert set(owners.get(name, ["toolpoint"])) == {"toolpoint"}, name


def test_a_package_that_takes_one_of_the_names_is_found(tmp_path, monkeypatch):
    intruder = tmp_path / "intruder-1.0.dist-info"
    intruder.mkdir()
    (intruder / "METADATA").write_text("Metadata-Version: 2.1\nName: intruder\nVersion: 1.0\n", encoding="utf-8")
    (intruder / "top_level.txt").write_text("models\n", encoding="utf-8")
    (intruder / "RECORD").write_text("models/__init__.py,,\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    findings = {finding.subject: finding for finding in examine()}
    assert not findings["package names"].passed
    assert "models also belongs to intruder" in findings["package names"].detail


def test_the_model_of_a_machine_is_looked_at(tmp_path):
    path = tmp_path / "toolpoint.yaml"
    sample = sample_configuration().replace("#model_file: /var/lib/toolpoint-models", f"model_file: {tmp_path}")
    assert f"model_file: {tmp_path}/model.json" in sample
    path.write_text(sample, encoding="utf-8")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert not found.passed and "there is no thermal model; release one" in found.detail
    path.write_text("machine: [", encoding="utf-8")
    found = {finding.subject: finding for finding in examine(path)}["thermal model"]
    assert not found.passed and str(path) in found.detail


def test_the_command_prints_what_it_finds():
    finished = subprocess.run(
        [sys.executable, "-P", "-m", "daemon.cli", "doctor"], capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode in (0, 1), finished.stderr
    assert "package names" in finished.stdout and "Traceback" not in finished.stderr


def test_what_a_control_says_of_itself_does_not_act_on_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    show_finding(Finding(subject="cnc", passed=True, detail="ACME\x1b]0;owned\x07\x1b[2J 30i, NOT secure"))
    said = capsys.readouterr().out
    assert "ACME\\x1b]0;owned\\x07\\x1b[2J 30i" in said
    assert "\x07" not in said and "\x1b[2J" not in said


async def test_a_line_whose_port_is_missing_is_named_once() -> None:
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    async for finding in preflight(configuration, SystemClock(), devices=True):
        if finding.subject.startswith("line "):
            assert finding.detail.startswith("port ") and not finding.passed
            return
    pytest.fail("no line was tried")
