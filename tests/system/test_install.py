"""The installer: proves its bundle, needs no network, and leaves a way back."""

import base64
import hashlib
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INSTALLER = ROOT / "systemd/install.sh"
PROGRAM = "def main():\n    print('{name}, version {version}')\n"


def wheel(folder: Path, version: str, name: str = "toolpoint", more: str = "") -> None:
    """Write a wheel that calls itself Toolpoint; the real bundle is built and installed by .ci/run."""
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}_stand_in.py": PROGRAM.format(name=name, version=version),
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{more}",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": f"[console_scripts]\n{name} = {name}_stand_in:main\n",
    }
    record = "".join(
        f"{path},sha256={base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b'=').decode()},"
        f"{len(text.encode())}\n"
        for path, text in files.items()
    )
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as archive:
        for path, text in (files | {f"{info}/RECORD": f"{record}{info}/RECORD,,\n"}).items():
            archive.writestr(path, text)


def bundle(folder: Path, version: str) -> Path:
    """Make what `make bundle` makes, with a small program."""
    made = folder / f"bundle-{version}"
    (made / "wheels").mkdir(parents=True)
    wheel(made / "wheels", version, more='Provides-Extra: more\nRequires-Dist: added; extra == "more"\n')
    wheel(made / "wheels", "1.0", name="added")
    (made / "extras").write_text("more\n", encoding="utf-8")
    shutil.copytree(ROOT / "systemd", made / "systemd")
    shutil.copy(INSTALLER, made / "install.sh")
    shutil.copy(ROOT / "constraints.txt", made / "constraints.txt")
    sums = "".join(
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  ./{path.relative_to(made)}\n"
        for path in sorted(made.rglob("*"))
        if path.is_file()
    )
    (made / "SHA256SUMS").write_text(sums, encoding="utf-8")
    return made


def install(made: Path, prefix: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    """Run the installer where no package index can be reached."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    environment |= {"PIP_CONFIG_FILE": os.devnull, "PIP_INDEX_URL": "https://127.0.0.1:1/", "PIP_RETRIES": "0"}
    command = ["sh", str(made / "install.sh"), "--prefix", str(prefix), "--python", sys.executable, *options]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=300, check=False, umask=0o077
    )


def current(prefix: Path) -> str:
    program = prefix / "current/bin/toolpoint"
    return subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()[-1]


@pytest.mark.wires
def test_install_upgrade_and_back(tmp_path: Path) -> None:
    prefix, root = tmp_path / "opt", tmp_path / "root"
    earlier = prefix / "0.0.1/bin/toolpoint"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("#!/bin/sh\necho toolpoint, version 0.0.1\n", encoding="utf-8")
    earlier.chmod(0o755)
    (prefix / "current").symlink_to("0.0.1")

    made = bundle(tmp_path, "0.0.2")
    (root / "usr").mkdir(parents=True)
    (root / "usr/lib").write_text("in the way", encoding="utf-8")
    broken_off = install(made, prefix, "--root", str(root))
    assert broken_off.returncode != 0 and current(prefix) == "0.0.1"
    (root / "usr/lib").unlink()
    done = install(made, prefix, "--root", str(root))
    assert done.returncode == 0, done.stderr
    modes = [(prefix / "0.0.2" / name).stat().st_mode for name in ("bin/toolpoint", "lib")]
    assert all(mode & 0o055 == 0o055 for mode in modes), "for other accounts too, whatever the mask of this one"
    assert (prefix / "0.0.2/bin/added").exists(), "of the extra that the bundle brings along"
    assert current(prefix) == "0.0.2" and "systemctl restart toolpoint" in done.stdout
    placed = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
    assert placed == {
        "etc/systemd/system/toolpoint.service",
        "etc/systemd/system/toolpoint-sink.service",
        "etc/systemd/system/toolpoint-store.service",
        "etc/systemd/system/toolpoint-release.service",
        "etc/systemd/system/toolpoint-release.path",
        "usr/lib/sysusers.d/toolpoint.conf",
        "usr/lib/tmpfiles.d/toolpoint.conf",
        "etc/udev/rules.d/60-toolpoint.rules",
        "usr/local/bin/toolpoint",
    }
    by_name = root / "usr/local/bin/toolpoint"
    assert by_name.readlink() == prefix / "current/bin/toolpoint", "the command of the guides, in any version"

    for unit in ("toolpoint.service", "toolpoint-sink.service", "toolpoint-store.service", "toolpoint-release.service"):
        text = (root / "etc/systemd/system" / unit).read_text("utf-8")
        assert f"ExecStart={prefix}/current/bin/toolpoint" in text and "/opt/toolpoint" not in text

    back = install(made, prefix, "--switch", "0.0.1")
    assert back.returncode == 0 and current(prefix) == "0.0.1"
    nowhere = install(made, prefix, "--switch", "0.0.9")
    assert nowhere.returncode == 1 and "0.0.2" in nowhere.stderr and current(prefix) == "0.0.1"
    assert nowhere.stderr.rstrip().endswith("there are: 0.0.1 0.0.2"), "`current` is no version"
    again = install(made, prefix, "--program-only")
    assert again.returncode == 1 and "installed" in again.stderr and current(prefix) == "0.0.1"
    assert sorted(path.name for path in prefix.iterdir()) == ["0.0.1", "0.0.2", "current"]

    by_name.unlink()
    by_name.write_text("somebody's own", encoding="utf-8")
    shutil.rmtree(prefix / "0.0.2")
    sink = root / "etc/systemd/system/toolpoint-sink.service"
    as_shipped = sink.read_text("utf-8")
    sink.write_text(as_shipped.replace("#LoadCredential=mail", "LoadCredential=mail"), encoding="utf-8")
    beside = install(made, prefix, "--root", f"{root}/")
    assert sink.read_text("utf-8") == as_shipped
    changed = sink.with_name(f"{sink.name}.before-0.0.2")
    assert "\nLoadCredential=mail" in changed.read_text("utf-8"), "what somebody changed is not lost"
    assert "//" not in beside.stderr
    assert changed.name in beside.stderr and f"systemctl edit {sink.name}" in beside.stderr
    assert list(sink.parent.glob("*.before-*")) == [changed], "of the units that were as they come, none is kept"
    assert beside.returncode == 0 and by_name.read_text("utf-8") == "somebody's own"
    assert f"{by_name} is there already" in beside.stderr and f"{prefix}/current/bin/toolpoint" in beside.stderr


@pytest.mark.parametrize(
    ("shell", "asks"),
    [
        (["bash", "-i"], "complete -p toolpoint"),
        (["zsh", "-i"], "print -r -- $_comps[toolpoint]"),
        (["fish"], "complete -C 'toolpoint sin'"),
    ],
    ids=["bash", "zsh", "fish"],
)
def test_the_completion_of_the_guide_works_for_somebody_without_a_startup_file(
    tmp_path: Path, shell: list[str], asks: str
) -> None:
    if shutil.which(shell[0]) is None:
        pytest.skip(f"{shell[0]} is not installed")
    guide = (ROOT / "docs/how-to/install.md").read_text("utf-8").split("Completion of commands", 1)[1]
    lines = guide.split("\nWhat is there now", 1)[0].split(":\n", 1)[1]
    program = Path(sys.executable).parent / "toolpoint"
    environment = {"HOME": str(tmp_path), "PATH": f"{program.parent}:{os.environ['PATH']}", "TERM": "dumb"}

    def run(command: list[str]) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)

    made = run(["sh", "-ec", lines.replace("/opt/toolpoint/current/bin/toolpoint", str(program))])
    assert made.returncode == 0, made.stderr
    asked = run([*shell, "-c", asks])
    assert "sink" in asked.stdout or "_toolpoint_completion" in asked.stdout, asked.stderr
    assert "command not found" not in asked.stderr


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda made: (made / "constraints.txt").write_text("numpy==0\n"), "damaged on its way"),
        (lambda made: (made / "wheels/toolpoint-0.0.1-py3-none-any.whl").unlink(), "damaged on its way"),
        (lambda made: (made / "SHA256SUMS").unlink(), "is no bundle"),
    ],
    ids=["changed", "missing", "no list"],
)
def test_a_damaged_bundle_installs_nothing(tmp_path: Path, damage: object, words: str) -> None:
    made = bundle(tmp_path, "0.0.1")
    damage(made)  # type: ignore[operator]
    done = install(made, tmp_path / "opt")
    assert done.returncode == 1 and words in done.stderr
    assert not (tmp_path / "opt").exists()


def test_what_is_left_of_an_installation_that_was_broken_off_is_told(tmp_path: Path) -> None:
    (tmp_path / "opt/0.0.1/bin").mkdir(parents=True)
    done = install(bundle(tmp_path, "0.0.1"), tmp_path / "opt", "--program-only")
    assert done.returncode == 1 and f"{tmp_path}/opt/0.0.1 is left from an installation" in done.stderr


def test_an_installation_whose_terminal_goes_leaves_nothing_half_done(tmp_path: Path) -> None:
    """Such as over a network: the units would be those of before, and the next run would find it installed."""
    own = tmp_path / "python3"
    hung_up = 'kill -HUP $PPID; mkdir -p "$3/bin"; exit 0'
    own.write_text(f'#!/bin/sh\ncase "$*" in *"-m venv"*) {hung_up} ;; *) exec {sys.executable} "$@" ;; esac\n')
    own.chmod(0o755)
    done = install(bundle(tmp_path, "0.0.1"), tmp_path / "opt", "--python", str(own), "--program-only")
    assert done.returncode != 0 and list((tmp_path / "opt").iterdir()) == []


@pytest.mark.parametrize("option", ["--prefix", "--switch"])
def test_an_option_without_a_value_is_refused(tmp_path: Path, option: str) -> None:
    for value in ([], [""]):
        done = install(bundle(tmp_path / f"{len(value)}", "0.0.1"), tmp_path / "opt", option, *value)
        assert done.returncode == 1 and f"{option} takes a value" in done.stderr
    assert not (tmp_path / "opt").exists()


@pytest.mark.parametrize(
    ("options", "words"), [(["--root", "/x"], "the units cannot name"), ([], "the units cannot name")]
)
def test_a_folder_that_the_units_cannot_name_is_refused(tmp_path: Path, options: list[str], words: str) -> None:
    done = install(bundle(tmp_path, "0.0.1"), tmp_path / "with space", *options)
    assert done.returncode == 1 and words in done.stderr
    assert not (tmp_path / "with space").exists()


def test_a_python_of_somebody_s_home_is_refused(tmp_path: Path) -> None:
    own = tmp_path / "python3"  # as pyenv and uv install one; it must not come so far as to install anything here
    told = "*base_prefix*) echo /home/anna/.pyenv/versions/3.11.7 ;; *venv*) exit 1 ;;"
    own.write_text(f'#!/bin/sh\ncase "$*" in {told} *) exec {sys.executable} "$@" ;; esac\n', encoding="utf-8")
    own.chmod(0o755)
    prefix = Path("/opt/toolpoint-of-nobody")
    done = install(bundle(tmp_path, "0.0.1"), prefix, "--python", str(own))
    assert done.returncode == 1 and "the service cannot look into /home/anna/.pyenv/versions/3.11.7" in done.stderr
    assert "--python" in done.stderr and not prefix.exists()


def test_a_folder_that_a_link_leads_into_the_homes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "opt").symlink_to("/home")
    prefix = tmp_path / "opt/toolpoint-of-nobody"
    own = tmp_path / "python3"  # it must not come so far as to install anything here
    own.write_text(
        f'#!/bin/sh\ncase "$*" in *venv*) exit 1 ;; *) exec {sys.executable} "$@" ;; esac\n', encoding="utf-8"
    )
    own.chmod(0o755)
    done = install(bundle(tmp_path, "0.0.1"), prefix, "--python", str(own))
    assert done.returncode == 1 and f"the service cannot look into {prefix}" in done.stderr
    assert not prefix.exists()


def test_the_installer_says_how_it_is_used() -> None:
    shown = subprocess.run(["sh", str(INSTALLER), "--help"], capture_output=True, text=True, check=False)
    assert shown.returncode == 0 and "--switch VERSION" in shown.stdout
    wrong = subprocess.run(["sh", str(INSTALLER), "--nonsense"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2 and "--switch VERSION" in wrong.stderr
