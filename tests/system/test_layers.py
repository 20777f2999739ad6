"""Imports run one way: daemon -> drivers -> config -> models."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINT = Path(sys.executable).with_name("lint-imports")


def test_imports_run_one_way() -> None:
    done = subprocess.run(
        [LINT, "--no-cache", "--config", str(ROOT / "pyproject.toml")],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_wrong_import_is_found(tmp_path: Path) -> None:
    for package in ("upper_part", "lower_part"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("")
    (tmp_path / "lower_part" / "wrong.py").write_text("import upper_part\n")
    (tmp_path / "rule.toml").write_text(
        '[tool.importlinter]\nroot_packages = ["upper_part", "lower_part"]\n'
        '[[tool.importlinter.contracts]]\nname = "one way"\ntype = "layers"\n'
        'layers = ["upper_part", "lower_part"]\n'
    )
    done = subprocess.run(
        [LINT, "--no-cache", "--config", "rule.toml"], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 1
    assert "lower_part.wrong" in done.stdout


def test_importing_the_resident_daemon_leaves_fitting_libraries_out() -> None:
    code = "import sys, daemon.app; print(sorted({'sklearn', 'scipy', 'pyarrow'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False, cwd="/")
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr
