"""What is imported and who writes: beyond the contracts of `make layers`, which CI checks before the tests."""

import ast
import subprocess
import sys
from pathlib import Path

from source_trees import tree

ROOT = Path(__file__).parents[2]
PARTS = ("daemon", "drivers", "config", "models")


def test_importing_the_resident_daemon_leaves_fitting_libraries_out() -> None:
    code = "import sys, daemon.app; print(sorted({'sklearn', 'scipy', 'pyarrow'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False, cwd="/")
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def users_of_write_macros(root: Path) -> list[str]:
    """Return every file that reaches for a CNC's `write_macros`, by attribute or by name; a definition is none."""
    found = []
    for path in sorted(file for part in PARTS for file in root.glob(f"{part}/**/*.py")):
        for node in ast.walk(tree(path)):
            name = getattr(node, "attr", None) or getattr(node, "value", None)
            if name == "write_macros":
                found.append(path.relative_to(root).as_posix())
    return found


def test_one_module_alone_writes_macros() -> None:
    assert users_of_write_macros(ROOT) == ["daemon/cnc/audited_write.py"]


def test_a_second_caller_is_found(tmp_path: Path) -> None:
    planted = {
        "daemon/cnc/second.py": "async def write(cnc):\n    await cnc.write_macros([[(500, 1.0)]])\n",
        "daemon/third.py": "def write(cnc):\n    return getattr(cnc, 'write_macros')\n",
        "drivers/opcua/fourth.py": "from drivers.opcua.cnc import OpcUaCnc\nsend = OpcUaCnc.write_macros\n",
        "drivers/opcua/cnc.py": "class OpcUaCnc:\n    async def write_macros(self, groups):\n        ...\n",
    }
    for name, text in planted.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert users_of_write_macros(tmp_path) == ["daemon/cnc/second.py", "daemon/third.py", "drivers/opcua/fourth.py"]
