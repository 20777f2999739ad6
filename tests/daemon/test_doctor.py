"""What `toolpoint doctor` finds on this computer."""

import importlib.metadata
import subprocess
import sys

import pytest

from config.loader import load_configuration
from config.machines import shipped_file
from config.sample import sample_configuration
from daemon.checkup.computer import OUR_PACKAGES, examine
from daemon.checkup.machine import preflight
from drivers.clock import SystemClock


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


async def test_a_line_whose_port_is_missing_is_named_once() -> None:
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    async for finding in preflight(configuration, SystemClock(), devices=True):
        if finding.subject.startswith("line "):
            assert finding.detail.startswith("port ") and not finding.passed
            return
    pytest.fail("no line was tried")
