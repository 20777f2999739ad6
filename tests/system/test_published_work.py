"""The page of the published work leaves no equation out and names what exists."""

import importlib
import re
from pathlib import Path

import pytest
from render_commands import commands

from daemon.cli import main

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/published-work.md").read_text("utf-8")
LAST_EQUATION = {"1": 5, "3": 5, "4": 39, "5": 9, "C": 5}
"""Chapter or appendix -> number of its last equation; every one before it is printed."""
FIGURES_OF_RESULTS = {"3": range(2, 23), "5": range(2, 27)}
WITHOUT_RESULTS = {("5", 16), ("5", 20)}
"""Photographs of set-ups."""


def table(heading: str) -> list[list[str]]:
    text = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def numbers(cell: str) -> list[tuple[str, int]]:
    """`4-19 to 4-21, 4-23` -> every number that it names."""
    found = []
    for part in cell.split(", "):
        ends = [each.split("-") for each in part.split(" to ")]
        found += [(ends[0][0], number) for number in range(int(ends[0][1]), int(ends[-1][1]) + 1)]
    return found


def test_every_equation_stands_there_once() -> None:
    found = [number for row in table("Equations") for number in numbers(row[0])]
    assert sorted(found) == sorted((chapter, n) for chapter, last in LAST_EQUATION.items() for n in range(1, last + 1))


def test_every_figure_of_thermal_and_dynamic_results_stands_there_once() -> None:
    found = [number for row in table("Figures") for number in numbers(row[0])]
    wanted = {(chapter, n) for chapter, places in FIGURES_OF_RESULTS.items() for n in places}
    assert len(found) == len(set(found))
    assert wanted - set(found) == WITHOUT_RESULTS


@pytest.mark.parametrize("row", table("Equations"), ids=lambda row: row[0])
def test_what_holds_an_equation_exists(row: list[str]) -> None:
    for module, name in re.findall(r"`(models[\w.]*):(\w+)`", row[2]):
        assert getattr(importlib.import_module(module), name).__doc__, name


@pytest.mark.parametrize("row", [*table("Equations"), *table("Tables")], ids=lambda row: row[0])
def test_what_tests_it_exists(row: list[str]) -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", row[3])
    assert named
    for file, test in named:
        assert f"def {test}" in (ROOT / file).read_text("utf-8"), test


@pytest.mark.parametrize("row", table("Tables"), ids=lambda row: row[0])
def test_files_of_tables_exist(row: list[str]) -> None:
    assert (ROOT / row[2].strip("`")).is_file()


def test_commands_that_draw_figures_exist_with_their_options() -> None:
    shown = re.findall(r"`toolpoint ([^`]+)`", PAGE)
    assert len(shown) > 15
    known = {" ".join(words): command for words, command in commands(main)}
    for line in shown:
        words = line.split()
        command = known.get(" ".join(words[:2])) or known[words[0]]
        options = {option for each in command.params for option in (*each.opts, *each.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= options, line
