"""Packages of npm that tests use as peers, installed once into a cache (environment variable TOOLPOINT_NODE_CACHE)."""

import fcntl
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

INSTALL_TIMEOUT_S = 600.0
NEEDS_NODE = pytest.mark.skipif(
    shutil.which("node") is None or shutil.which("npm") is None, reason="node and npm are not on this computer"
)


def installed(folder: Path) -> dict[str, str]:
    """Install what the `package.json` of a folder names; return the environment in which node finds it."""
    package = (folder / "package.json").read_bytes()
    default = Path.home() / ".cache" / "toolpoint-tests"
    cache = Path(os.environ.get("TOOLPOINT_NODE_CACHE", default)) / hashlib.sha256(package).hexdigest()[:16]
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (cache / "installed").exists():
            (cache / "package.json").write_bytes(package)
            command = ["npm", "install", "--no-package-lock", "--ignore-scripts", "--no-audit", "--no-fund"]
            done = subprocess.run(
                command, cwd=cache, capture_output=True, text=True, timeout=INSTALL_TIMEOUT_S, check=False
            )
            assert done.returncode == 0, f"npm install failed:\n{done.stdout}\n{done.stderr}"
            (cache / "installed").touch()
    return os.environ | {"NODE_PATH": str(cache / "node_modules"), "HOME": str(cache), "XDG_CONFIG_HOME": str(cache)}
