"""The glossary binds the names in the program: what it names is there, and what it rules out is not."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from source_trees import tree

ROOT = Path(__file__).parents[2]
PACKAGES = ("models", "drivers", "config", "daemon")


@cache
def names() -> frozenset[str]:
    """Return every name that the program gives to something: modules, classes, functions, arguments, fields."""
    found = set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            found |= {path.stem, path.parent.name}
            for node in ast.walk(tree(path)):
                match node:
                    case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                        found.add(name)
                    case ast.arg(arg=name):
                        found.add(name)
                    case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                        found.add(name)
    return frozenset(found)


def parts(name: str) -> list[str]:
    """Return the words of a name in lower case: `ModelShelf` and `_model_shelf` are both model, shelf."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", name)]


def uses(word: str) -> list[str]:
    """Return the names that have all parts of the word side by side; of a class's name, that name alone."""
    if word[0].isupper():
        return [word] if word in names() else []
    wanted = f" {' '.join(parts(word))} "
    return sorted(name for name in names() if wanted in f" {' '.join(parts(name))} ")


def rows(heading: str) -> list[list[str]]:
    """Return the cells of a table of the glossary."""
    text = (ROOT / "docs/glossary.md").read_text("utf-8").split(f"{heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


RULED_OUT = [word for row in rows("## Words that are not used") for word in quoted(row[0])]


def test_the_glossary_is_sorted_and_names_what_exists() -> None:
    table = rows("# Glossary")
    words = [row[0].lower() for row in table]
    assert words == sorted(words) and len(set(words)) == len(words)
    named = {name for row in table for name in quoted(row[2])}
    assert len(named) > 40 and not named - names()


@pytest.mark.parametrize("word", RULED_OUT)
def test_no_name_has_a_word_that_is_ruled_out(word: str) -> None:
    found = uses(word)
    assert not found, f"{word} is ruled out by the glossary (docs/glossary.md): {found}"
