"""Tables of the documentation that repeat the code say what the code says."""

import json
import re
import runpy
from pathlib import Path

import pytest
from render_commands import commands

from daemon.cli import main
from daemon.simulation.demonstration import result
from daemon.telemetry.metrics import Telemetry
from drivers.guard import linuxcnc, sinumerik
from drivers.sim.faults import FaultKind
from drivers.sim.nc.safe_point import GuardStatus
from models.control.compensation import TRANSITIONS
from models.quality import Quality, Reason
from models.records import OutputState, WriteOutcome

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def section(name: str, heading: str) -> str:
    """The text below a heading, up to the next one of its level."""
    text = (DOCS / name).read_text(encoding="utf-8")
    level = heading.split(" ", maxsplit=1)[0]
    match = re.search(rf"^{re.escape(heading)}$(.*?)(?=^#{{1,{len(level)}}} |\Z)", text, re.DOTALL | re.MULTILINE)
    assert match, f"{name}: there is no heading {heading!r}"
    return match[1]


def rows(text: str) -> list[list[str]]:
    """The cells of every table row, heads and rules left out."""
    lines = text.splitlines()
    found = []
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("|") and not line.startswith("|--") and not following.startswith("|--"):
            found.append([cell.strip() for cell in line.strip("|").split("|")])
    return found


def anchors(path: Path) -> set[str]:
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_the_table_of_states_is_the_state_machine() -> None:
    expected = [
        [state.value, str(condition), target.value]
        for state, leaves in TRANSITIONS.items()
        for condition, target in leaves
    ]
    assert rows(section("explanation/compensation.md", "## The state table")) == expected


def test_the_operator_is_told_what_to_do_in_every_state() -> None:
    found = rows(section("how-to/operate.md", "## States and what to do"))
    assert [row[0] for row in found] == [state.value for state in OutputState]


@pytest.mark.parametrize(
    "name,heading,codes",
    [
        ("reference/history.md", "### Quality", Quality),
        ("reference/history.md", "### Reason", Reason),
        ("reference/history.md", "### Outcome of a write", WriteOutcome),
        ("reference/macros.md", "### Status codes", GuardStatus),
    ],
)
def test_codes_are_those_of_the_code(
    name: str, heading: str, codes: type[Quality] | type[Reason] | type[WriteOutcome] | type[GuardStatus]
) -> None:
    expected = [[str(int(code)), code.name.lower().replace("_", " ")] for code in codes]
    assert [row[:2] for row in rows(section(name, heading))] == expected


def test_every_message_of_the_nc_programs_is_explained() -> None:
    stops = re.compile(r"(?:#3000=\d+|(?<!O)\{\w+\})\((TOOLPOINT [A-Z0-9 ]+)\)|\(ABORT, (TOOLPOINT [A-Z0-9 ]+)\)")
    text = "".join(path.read_text("ascii") for path in (ROOT / "drivers/guard").glob("*.nc"))
    found = {words for pair in stops.findall(text) for words in pair if words} | set(linuxcnc.WORDS.values())
    found |= {f"TOOLPOINT {words}" for words in sinumerik.WORDS.values()}
    found |= {f"TOOLPOINT {words.replace('SPEED S F', 'S F')}" for _, words in sinumerik.SPEED_WORDS.values()}
    pages = " ".join(
        (DOCS / f"how-to/{name}.md").read_text("utf-8")
        for name in ("install-the-guard-macro", "tune-the-spindle-speed")
    )
    told = " ".join(pages.split())
    assert len(found) > 20
    assert [words for words in sorted(found) if words.removeprefix("TOOLPOINT ") not in told] == []


def test_every_kind_of_fault_is_listed() -> None:
    found = rows(section("explanation/simulated-machine.md", "## Fault scripts"))
    assert [row[0] for row in found] == [f"`{kind}`" for kind in FaultKind]


def test_alarms_name_metrics_that_exist() -> None:
    text = (DOCS / "reference" / "metrics.md").read_text(encoding="utf-8")
    families = Telemetry().registry.collect()
    served = {f"{family.name}_total" if family.type == "counter" else family.name for family in families}
    used = set(re.findall(r"(toolpoint_\w+)[{\[]", text))
    assert used
    assert used <= served


def test_the_demo_prints_the_keys_that_are_documented() -> None:
    block = re.search(r"```json\n(.*?)```", section("reference/json-output.md", DEMO_HEADING), re.DOTALL)
    assert block
    documented = json.loads(block[1])
    truth = {"uncompensated_max_um": 8.0, "compensated_max_um": 1.0}
    final = {"truth": {"z": truth}, "cycles_sent": {"line": 1}, "cycles_disturbed": {"line": 0}, "late_real_s": 0.0}
    delay = {"mean": 0.1, "p50": 0.1, "p99": 0.1, "max": 0.1, "p999": 0.1, "samples": 1}
    axis = {"estimate_from": "Z1", "applied_um": 1.0, "bound_um": 10.0, "wanted": True}
    status = {
        "axes": {"z": axis},
        "cycles": {"received": 1, "incomplete": 0},
        "estimates": 1,
        "writes": {"sent": 1, "verified": 1, "refused": 0},
        "latency_s": {"feedback": delay, "total": delay},
        "written_axes": ["z"],
        "output": {"state": "ACTIVE", "reason": "following the estimate"},
        "spindle_speed": None,
    }
    numbers, failures = result(final, status, 60.0, 5.0)
    assert failures == []
    assert shape(numbers) == shape(documented)


DEMO_HEADING = "## `toolpoint demo --headless --minutes M --speed X --json -`"


def shape(value: object) -> object:
    """The keys of nested mappings."""
    return {key: shape(item) for key, item in value.items()} if isinstance(value, dict) else None


@pytest.mark.parametrize("path", [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))], ids=lambda path: path.stem)
def test_anchors_of_links_exist(path: Path) -> None:
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    for name, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", text):
        target = (path.parent / name).resolve() if name else path
        assert anchor in anchors(target), f"{path.name}: {name}#{anchor} names no heading"


def test_every_decision_is_listed() -> None:
    text = section("explanation/architecture.md", "## Decisions")
    for path in (DOCS / "explanation" / "decisions").glob("*.md"):
        assert f"(decisions/{path.name})" in text, path.name


def test_the_picture_is_small_and_fetches_nothing() -> None:
    picture = (DOCS / "images" / "demo.svg").read_text(encoding="utf-8")
    assert len(picture) < 200_000
    assert "url(http" not in picture
    assert "@import" not in picture
    assert "<script" not in picture


def test_the_picture_of_the_terminal_is_the_view_as_it_is() -> None:
    render = runpy.run_path(str(DOCS / "images" / "render_demo.py"))
    last = (DOCS / "images" / "demo.svg").read_text(encoding="utf-8").splitlines()[-1]
    assert last == render["made_by"](), "the view has changed: .venv/bin/python -P docs/images/render_demo.py"


def test_every_command_that_writes_json_is_where_its_keys_are() -> None:
    """`dynamics blank` and `simulate` were on no page; below the heading of a group stands the last word alone."""
    page = (DOCS / "reference" / "json-output.md").read_text(encoding="utf-8")
    stability = (DOCS / "reference" / "stability-files.md").read_text(encoding="utf-8")
    groups = {"dynamics": section("reference/json-output.md", DYNAMICS_HEADING), "stability": stability}
    for path, command in commands(main):
        if any("--json" in option.opts for option in command.params):
            names = [f"`{path[-1]}`", *([] if path[0] in groups else [f"`toolpoint {' '.join(path)}"])]
            text = groups.get(path[0], page)
            assert any(re.search(rf"{re.escape(name)}(?![\w-])", text) for name in names), path


DYNAMICS_HEADING = "## `toolpoint dynamics ... --json -`"
