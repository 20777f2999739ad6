"""What the architecture page says of the code is so."""

import ast
import re
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args

from source_trees import tree

from daemon import messages, snapshots
from daemon.compensation.parts import ControlParts
from daemon.estimation.inputs import Message
from models import records
from models.records import TemperatureCycle
from models.thermal.family import ThermalModel

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
BESIDE = (
    "daemon/cli",
    "daemon/simulation",
    "daemon/workbench",
    "daemon/commissioning",
    "daemon/checkup",
    "drivers/sim",
)
"""What is not resident."""
STARTS_THREADS = {"to_thread", "run_in_executor", "Thread", "ThreadPoolExecutor", "Timer", "loop_start"}


def rows(heading: str, table: int = 0) -> list[list[str]]:
    """Return the cells of a table under a heading, without its head."""
    section = PAGE.split(f"\n{heading}\n", 1)[1].split("\n## ", 1)[0]
    tables = re.findall(r"(?:^\|.*\n)+", section, flags=re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|\n").split("|")] for line in tables[table].splitlines()[2:]]


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def contract(name: str) -> dict[str, Any]:
    (found,) = [each for each in CONTRACTS if each["name"] == name]
    return found


def test_the_layers_are_those_of_the_contract() -> None:
    layers = contract("the layers of daemon/")
    assert [set(names(row[0])) for row in rows("## Packages of the daemon")] == [
        {package.strip() for package in layer.split("|")} for layer in layers["layers"]
    ]
    assert layers["exhaustive"], "a new package needs a row"


def test_only_the_simulation_and_the_tests_import_the_simulated_machine() -> None:
    importing = {
        str(path.relative_to(ROOT))
        for folder in ("models", "config", "drivers", "daemon")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ImportFrom | ast.Import) and any("drivers.sim" in name for name in imported(node))
    }
    assert importing
    assert {path for path in importing if not path.startswith(("daemon/simulation/", "drivers/sim/"))} == set()
    assert "ignore_imports" not in contract("only daemon.simulation imports the simulated machine")


def imported(node: ast.Import | ast.ImportFrom) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [f"{node.module}.{alias.name}" for alias in node.names]


def test_what_goes_back_to_the_thermal_task_are_five_frozen_messages() -> None:
    upwards = set(get_args(Message)) - {ThermalModel, TemperatureCycle}
    told = {names(row[0])[0] for row in rows("## From sensor to CNC")}
    assert {each.__name__ for each in upwards} == told
    for message in upwards:
        assert is_dataclass(message) and message.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert str(ControlParts.__annotations__["tell_thermal"]).endswith("None]"), "an answer is not waited for"


def test_records_messages_and_snapshots_are_frozen() -> None:
    found = [
        each
        for module in (records, messages, snapshots)
        for each in vars(module).values()
        if isinstance(each, type) and is_dataclass(each) and each.__module__ == module.__name__
    ]
    assert len(found) > 20
    for record in found:
        assert record.__dataclass_params__.frozen, record  # type: ignore[attr-defined]
        assert fields(record)


def test_threads_are_started_where_the_page_says_and_nowhere_else() -> None:
    starting = set()
    for folder in ("models", "config", "drivers", "daemon"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            place = str(path.relative_to(ROOT))
            if not place.startswith(BESIDE):
                calls = (node for node in ast.walk(tree(path)) if isinstance(node, ast.Call))
                starting |= {place for call in calls if called(call) in STARTS_THREADS}
    assert starting == {names(row[0])[0] for row in rows("## Time and ownership", table=1)}


def called(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def test_the_monitor_reads_snapshots_and_no_task() -> None:
    allowed = ("daemon.monitor", "daemon.snapshots", "daemon.messages", "daemon.telemetry", "daemon.rate_limit")
    allowed += ("daemon.history.",)  # through the reader, in threads of its own
    for path in sorted((ROOT / "daemon" / "monitor").rglob("*.py")):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ImportFrom | ast.Import):
                for name in imported(node):
                    assert not name.startswith("daemon.") or name.startswith(allowed), f"{path.name}: {name}"
