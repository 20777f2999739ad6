"""The safety case names hazards, what prevents each, and tests that exist."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/explanation/safety-case.md").read_text("utf-8")
HAZARDS = dict(re.findall(r"^### (H\d+ [^\n]+)\n(.*?)(?=^##)", TEXT, re.MULTILINE | re.DOTALL))
TEST_ID = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


@cache
def names_in(path: Path) -> frozenset[str]:
    """Return the names of the tests that a file defines at its top level, or in a class."""
    tree = ast.parse(path.read_text("utf-8"))
    return frozenset(
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    )


def test_hazards_are_numbered_without_a_gap() -> None:
    assert [name.split()[0] for name in HAZARDS] == [f"H{number}" for number in range(1, len(HAZARDS) + 1)]
    assert len(HAZARDS) >= 10


@pytest.mark.parametrize("name", HAZARDS)
def test_a_hazard_says_what_prevents_it_and_which_tests_show_it(name: str) -> None:
    before, _, shown = HAZARDS[name].partition("Shown by:")
    assert "Prevented by: " in before
    named = TEST_ID.findall(shown)
    assert len(named) >= 2
    assert len(set(named)) == len(named)
    assert shown.count("`tests/") == len(named), "a test's name that this test cannot read"
    for file, test in named:
        assert (ROOT / file).is_file(), file
        assert test in names_in(ROOT / file), f"{file} has no {test}"


def test_nothing_outside_the_hazards_escapes_the_check() -> None:
    outside = TEXT
    for part in HAZARDS.values():
        outside = outside.replace(part, "")
    assert not TEST_ID.findall(outside)
