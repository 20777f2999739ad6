"""The files for the service manager, judged by the service manager's own tools."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "toolpoint.service"
MOST_EXPOSURE = 1.6


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed on this computer")
    return path


def settings(name: str) -> list[str]:
    lines = UNIT.read_text("utf-8").splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(f"{name}=")]


def test_unit_is_understood(tmp_path: Path) -> None:
    unit = tmp_path / UNIT.name
    program = Path(sys.executable).with_name("toolpoint")
    unit.write_text(UNIT.read_text("utf-8").replace("/opt/toolpoint/bin/toolpoint", str(program)), "utf-8")
    verified = subprocess.run(
        [tool("systemd-analyze"), "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False
    )
    own = [line for line in verified.stderr.splitlines() if "toolpoint" in line]
    assert (verified.returncode, own) == (0, [])


def test_unit_is_hardened() -> None:
    judged = subprocess.run(
        [tool("systemd-analyze"), "security", "--offline=true", "--no-pager", str(UNIT)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "LC_ALL": "C.UTF-8"},
    )
    found = re.search(r"Overall exposure level for toolpoint\.service: ([0-9.]+)", judged.stdout)
    assert found, judged.stdout + judged.stderr
    print(f"exposure {found[1]}")
    assert float(found[1]) <= MOST_EXPOSURE


def test_unit_is_fed_by_the_watchdog_and_not_restarted_over_a_bad_configuration() -> None:
    from config.schema.compensation import OutputConfig
    from daemon.cli.common import BAD_USAGE

    assert settings("Type") == ["notify"]
    (watchdog,) = settings("WatchdogSec")
    assert float(watchdog) >= 3 * OutputConfig().tick_s
    assert settings("RestartPreventExitStatus") == [str(BAD_USAGE)]
    assert "OPENBLAS_NUM_THREADS=1" in settings("Environment")


def test_unit_gives_the_folders_of_the_default_configuration() -> None:
    from config.schema.service import HistoryConfig, ServiceConfig
    from daemon.cli.common import DEFAULT_CONFIGURATION

    assert HistoryConfig().path.parent == Path("/var/lib") / settings("StateDirectory")[0]
    assert ServiceConfig().socket.parent == Path("/run") / settings("RuntimeDirectory")[0]
    assert settings("ExecStart") == [f"/opt/toolpoint/bin/toolpoint run --config {DEFAULT_CONFIGURATION}"]


def test_user_groups_and_folders_are_made(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("making users, even in a folder, needs root")
    (tmp_path / "etc").mkdir()
    for name in ("passwd", "group"):
        (tmp_path / "etc" / name).touch()
    for command in (
        [tool("systemd-sysusers"), f"--root={tmp_path}", str(SYSTEMD / "toolpoint.sysusers")],
        [tool("systemd-tmpfiles"), f"--root={tmp_path}", "--create", str(SYSTEMD / "toolpoint.tmpfiles")],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    groups = {
        line.split(":")[0]: line.split(":")[3] for line in (tmp_path / "etc/group").read_text("utf-8").splitlines()
    }
    assert groups == {"dialout": "toolpoint", "toolpoint-operators": "toolpoint", "toolpoint": ""}
    assert set(settings("SupplementaryGroups")[0].split()) == {"dialout", "toolpoint-operators"}
    assert (tmp_path / "etc/toolpoint/pki").stat().st_mode & 0o777 == 0o750


def test_udev_rules_have_the_form_of_rules() -> None:
    rules = [
        line
        for line in (SYSTEMD / "60-toolpoint.rules").read_text("utf-8").splitlines()
        if line and not line.startswith("# ") and line != "#"
    ]
    assert len(rules) == 4
    token = r'[A-Z]+(?:\{[A-Za-z_]+\})?(?:==|!=|\+=|=)"[^"]*"'
    for rule in rules:
        assert re.fullmatch(rf"{token}(?:, {token})*", rule.removeprefix("#")), rule
