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
RELEASE = SYSTEMD / "toolpoint-release.service"
SINK = SYSTEMD / "toolpoint-sink.service"
STORE = SYSTEMD / "toolpoint-store.service"
MOST_EXPOSURE = 1.6


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed on this computer")
    return path


def settings(name: str, unit: Path = UNIT) -> list[str]:
    lines = unit.read_text("utf-8").splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(f"{name}=")]


@pytest.mark.parametrize(
    "name", sorted(each.name for each in SYSTEMD.iterdir() if each.suffix in (".service", ".path"))
)
def test_unit_is_understood(tmp_path: Path, name: str) -> None:
    program = Path(sys.executable).with_name("toolpoint")
    for path in SYSTEMD.glob("toolpoint*.*"):
        if path.suffix in (".service", ".path"):
            text = path.read_text("utf-8").replace("/opt/toolpoint/current/bin/toolpoint", str(program))
            (tmp_path / path.name).write_text(text, "utf-8")
    verified = subprocess.run(
        [tool("systemd-analyze"), "verify", "--man=no", str(tmp_path / name)],
        capture_output=True,
        text=True,
        check=False,
    )
    own = [line for line in verified.stderr.splitlines() if "toolpoint" in line]
    assert (verified.returncode, own) == (0, [])


@pytest.mark.parametrize("unit", [UNIT, RELEASE, SINK, STORE], ids=lambda unit: unit.stem)
def test_unit_is_hardened(unit: Path) -> None:
    judged = subprocess.run(
        [tool("systemd-analyze"), "security", "--offline=true", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "LC_ALL": "C.UTF-8"},
    )
    found = re.search(r"Overall exposure level for toolpoint[a-z-]*\.service: ([0-9.]+)", judged.stdout)
    assert found, judged.stdout + judged.stderr
    print(f"exposure of {unit.name} {found[1]}")
    assert float(found[1]) <= MOST_EXPOSURE


def test_the_daemon_has_a_user_of_its_own_and_the_release_another() -> None:
    assert settings("DynamicUser") == ["true"]
    assert settings("User") == ["toolpoint"] and settings("User", RELEASE) == ["toolpoint-release"]
    assert settings("DeviceAllow") == ["char-ttyUSB rw", "char-ttyACM rw"]
    assert settings("ReadWritePaths") == [] and settings("ReadWritePaths", RELEASE) == ["/var/lib/toolpoint-models"]
    assert "toolpoint-release" not in settings("SupplementaryGroups")[0].split(), "or it could release its own model"
    assert settings("PrivateUsers") == [], "or every person at the socket would be nobody"
    assert settings("ExecReload") == ["/bin/kill -HUP $MAINPID"]
    allowed_again = settings("SystemCallFilter")[-1].split()
    assert "setpriority" in allowed_again, "packing and back-ups lower their priority"
    assert "@chown" in allowed_again, "or the command socket cannot be given to service.socket_group"
    users = (SYSTEMD / "toolpoint.sysusers").read_text("utf-8").splitlines()
    assert not [line for line in users if line.split()[:2] in (["u", "toolpoint"], ["g", "toolpoint"])]


def test_the_sinks_read_the_daemons_store_as_its_user_and_come_after_it() -> None:
    assert settings("User", SINK) == settings("User") and settings("StateDirectory", SINK) == settings("StateDirectory")
    assert int(settings("CPUWeight", SINK)[0]) < int(settings("CPUWeight")[0])
    assert int(settings("Nice")[0]) < 0 < int(settings("Nice", SINK)[0])
    assert int(settings("OOMScoreAdjust", SINK)[0]) > 0 > int(settings("OOMScoreAdjust")[0])


@pytest.mark.parametrize("unit", [UNIT, SINK])
def test_it_begins_when_the_calendar_is_right(unit: Path) -> None:
    assert "time-sync.target" in settings("After", unit)[0].split()


def test_secrets_reach_the_daemon_as_credentials() -> None:
    """The lines are commented out because a missing file would keep the service from starting."""
    lines = UNIT.read_text("utf-8").splitlines()
    loaded = dict(line.removeprefix("#LoadCredential=").split(":") for line in lines if "LoadCredential=" in line)
    assert set(loaded) == {"cnc-password", "toolpoint-key.pem", "backup-key.pem"}
    assert all(path.startswith("/etc/toolpoint/secrets/") for path in loaded.values())
    guide = (SYSTEMD.parent / "docs/how-to/install.md").read_text("utf-8")
    for name in loaded:
        assert f"/run/credentials/toolpoint.service/{name}" in guide


@pytest.mark.parametrize("unit", [SINK, STORE], ids=lambda unit: unit.stem)
def test_every_secret_that_the_guides_name_has_its_line_in_the_unit(unit: Path) -> None:
    guides = [path.read_text("utf-8") for path in sorted((SYSTEMD.parent / "docs/how-to").glob("*.md"))]
    named = {name for text in guides for name in re.findall(rf"/run/credentials/{unit.name}/([\w.-]+)", text)}
    loaded = set(re.findall(r"^#LoadCredential=([\w.-]+):/etc/toolpoint/secrets/\1$", unit.read_text("utf-8"), re.M))
    assert named and named <= loaded
    shown = {line for text in guides for line in re.findall(r"^    LoadCredential=(.+)$", text, re.M)}
    assert {f"{name}:/etc/toolpoint/secrets/{name}" for name in loaded} & shown


def test_no_guide_changes_a_unit_in_its_place_where_an_upgrade_writes_it_anew() -> None:
    for path in sorted((SYSTEMD.parent / "docs").rglob("*.md")):
        text = " ".join(path.read_text("utf-8").split())
        assert "take the `#`" not in text and "lines out of the unit" not in text, path


def test_unit_is_fed_by_the_watchdog_and_not_restarted_over_a_bad_configuration() -> None:
    from config.schema.compensation import OutputConfig
    from daemon.cli.common import BAD_USAGE

    assert settings("Type") == ["notify"]
    (watchdog,) = settings("WatchdogSec")
    assert float(watchdog) >= 3 * OutputConfig().tick_s
    assert settings("RestartPreventExitStatus") == [str(BAD_USAGE)]
    assert settings("StartLimitIntervalSec") == ["0"] and not settings("StartLimitBurst"), "it is tried for ever"
    assert "OPENBLAS_NUM_THREADS=1" in settings("Environment")


def test_unit_gives_the_folders_of_the_default_configuration() -> None:
    from config.schema.service import HistoryConfig, ServiceConfig
    from daemon.cli.common import DEFAULT_CONFIGURATION

    assert HistoryConfig().path.parent == Path("/var/lib") / settings("StateDirectory")[0]
    assert ServiceConfig().socket.parent == Path("/run") / settings("RuntimeDirectory")[0]
    assert settings("ExecStart") == [f"/opt/toolpoint/current/bin/toolpoint run --config {DEFAULT_CONFIGURATION}"]


def test_the_numbers_of_the_serial_ports_are_known_before_the_service_starts() -> None:
    """The service manager looks them up once: one plugged in later is refused to a service that began earlier."""
    modules = {"char-ttyUSB": "usbserial", "char-ttyACM": "cdc_acm"}
    allowed = [each.split()[0] for each in settings("DeviceAllow")]
    loaders = {f"modprobe@{modules[each]}.service" for each in allowed}
    assert loaders <= set(settings("Wants")[0].split()) and loaders <= set(settings("After")[0].split())


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
    assert groups == {"dialout": "", "toolpoint-operators": "", "toolpoint-release": ""}
    assert set(settings("SupplementaryGroups")[0].split()) == {"dialout", "toolpoint-operators"}
    modes = {
        "etc/toolpoint": 0o755,
        "etc/toolpoint/pki": 0o755,
        "etc/toolpoint/secrets": 0o700,
        "var/lib/toolpoint-models": 0o2775,
    }
    assert {name: (tmp_path / name).stat().st_mode & 0o7777 for name in modes} == modes
    assert (tmp_path / "var/lib/toolpoint-models").stat().st_gid == release_group_id(tmp_path)


def release_group_id(root: Path) -> int:
    lines = (root / "etc/group").read_text("utf-8").splitlines()
    return next(int(line.split(":")[2]) for line in lines if line.startswith("toolpoint-release:"))


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
