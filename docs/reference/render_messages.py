"""Make the page of the messages from the code, and from what `messages.yaml` says of each: its cause and what to do.

`python docs/reference/render_messages.py > docs/reference/messages.md`. What the code may say is read from its
source: every text of three words or more in the modules whose words reach an operator, with … for what is filled in.
A text that `messages.yaml` does not know, and an entry that no code says, end it with 1.
"""

import ast
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
FEWEST_WORDS = 3
PROGRAMMING_ERRORS = {"AssertionError", "KeyError", "RuntimeError", "TypeError", "ValueError"}
ROOMS: dict[str, tuple[str, ...]] = {
    "The output: why it holds, and what it tells": (
        "models/control",
        "daemon/compensation",
        "daemon/supervisor.py",
        "drivers/guard/sloped_axes.py",
    ),
    "Writing to the CNC": ("daemon/cnc",),
    "The link to the CNC": (
        "drivers/opcua/cnc.py",
        "drivers/opcua/variables.py",
        "drivers/contract.py",
        "drivers/focas/cnc.py",
        "drivers/focas/library.py",
        "drivers/focas/requests.py",
        "drivers/haas/cnc.py",
        "drivers/haas/requests.py",
        "drivers/linuxcnc/cnc.py",
        "drivers/bridge_link.py",
        "drivers/linked_cnc.py",
        "drivers/mtconnect",
        "drivers/power_on.py",
    ),
    "Temperatures and lines": ("drivers/latsis", "models/quality.py", "daemon/links.py"),
    "Other temperature sources": (
        "drivers/readings.py",
        "drivers/polling.py",
        "drivers/pushing.py",
        "drivers/json_fields.py",
        "drivers/modbus",
        "drivers/kernel.py",
        "drivers/process.py",
        "drivers/mqtt.py",
        "drivers/opcua/tags.py",
    ),
    "Displacements": ("drivers/displacement",),
    "The estimate and its model": (
        "daemon/estimation",
        "daemon/model_release/loading.py",
        "daemon/model_release/reload.py",
        "daemon/model_release/side_load.py",
        "models/thermal/bias.py",
    ),
    "The spindle speed": (
        "daemon/spindle_speed",
        "daemon/speed_planner.py",
        "models/spindle_speed/beside_the_band.py",
        "models/spindle_speed/choice.py",
        "models/spindle_speed/planner.py",
        "models/spindle_speed/tracked_tool_point.py",
        "models/spindle_speed/tuning.py",
        "models/spindle_speed/verification.py",
        "models/stability/response.py",
    ),
    "The OPC UA server": (
        "daemon/monitor/passwords.py",
        "daemon/monitor/opcua/users.py",
        "drivers/opcua/certificates.py",
        "drivers/opcua/server/settings.py",
        "drivers/opcua/server/wire.py",
    ),
    "Sinks: the history in other systems": (
        "daemon/sinks/watching.py",
        "daemon/sinks/postgresql_refusals.py",
        "daemon/sinks/broker_refusals.py",
        "daemon/sinks/vouching.py",
        "config/secret_files.py",
    ),
    "Alarms": (
        "daemon/sinks/alarms/observing.py",
        "daemon/sinks/alarms/mail.py",
        "daemon/sinks/alarms/webhook.py",
        "daemon/sinks/alarms/sending.py",
    ),
    "The history store": (
        "daemon/history/engine.py",
        "daemon/history/tidying.py",
        "daemon/history/writer.py",
        "daemon/history/store_lock.py",
        "daemon/state_store/store.py",
        "daemon/housekeeping",
    ),
}
"""Heading of the page -> modules and folders whose words an operator may read while the daemon runs."""


def messages(path: Path) -> list[str]:
    """Return what a module may say, in the order of its lines; … stands for what is filled in."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    unsaid = {id(part) for node in ast.walk(tree) for part in _unsaid(node)}
    said = [(node.lineno, text) for node in ast.walk(tree) if id(node) not in unsaid and (text := _template(node))]
    sentences = [text for _, text in sorted(said) if any(letter.isalpha() for letter in text)]
    return list(dict.fromkeys(text for text in sentences if len(text.split()) >= FEWEST_WORDS))


def _unsaid(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what of a node no operator reads: docstrings, the pieces of a longer text, a programming error's words."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        yield node.value
    elif isinstance(node, ast.JoinedStr):
        yield from (part for part in ast.walk(node) if isinstance(part, ast.Constant | ast.JoinedStr) and part != node)
    elif isinstance(node, ast.Assert):
        yield from ast.walk(node)
    elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        name = node.exc.func
        if isinstance(name, ast.Name) and name.id in PROGRAMMING_ERRORS:
            yield from ast.walk(node)


def _template(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return " ".join(node.value.split())
    if isinstance(node, ast.JoinedStr):
        text = "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
        return " ".join(text.split())
    return ""


def said_by(places: tuple[str, ...]) -> list[str]:
    """Return what the modules of a room may say."""
    paths = [
        module
        for place in places
        for module in ([ROOT / place] if place.endswith(".py") else sorted((ROOT / place).rglob("*.py")))
    ]
    return list(dict.fromkeys(text for path in paths for text in messages(path)))


def page(known: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return the page, and what is wrong with it: texts without an entry, and entries that nothing says."""
    lines = [
        "# Messages",
        "",
        "Every sentence that an operator may read while the daemon runs, in `toolpoint status`, on the monitor, in the",
        "log or in `toolpoint history`: its cause, and what to do. … stands for what is filled in. This page is made",
        "from the code by `docs/reference/render_messages.py`; a test checks that none is missing.",
    ]
    wrong, used = [], set[str]()
    for heading, places in ROOMS.items():
        lines += ["", f"## {heading}", "", "| what it says | cause | what to do |", "|---|---|---|"]
        for text in said_by(places):
            used.add(text)
            entry = known.get(text)
            if entry is None and text not in known:
                wrong.append(f"messages.yaml has no entry for {text!r}")
            elif isinstance(entry, Mapping):
                cells = [text, str(entry["cause"]), str(entry["do"])]
                lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |")
    wrong += [f"nothing says {text!r} any more: remove it from messages.yaml" for text in known if text not in used]
    return "\n".join(lines) + "\n", wrong


def entries() -> dict[str, Any]:
    """Return text -> {cause, do}, or why it is not listed, as `messages.yaml` has it."""
    content: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("messages.yaml").read_text(encoding="utf-8"))
    return content


if __name__ == "__main__":
    made, faults = page(entries())
    sys.stdout.write(made)
    for fault in faults:
        print(fault, file=sys.stderr)
    sys.exit(1 if faults else 0)
