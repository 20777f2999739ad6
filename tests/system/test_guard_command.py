"""`toolpoint guard` as a person uses it."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from config.machines import shipped_file
from daemon.cli import main
from drivers.sim.nc.custom_macro import compile_programs

CONFIGURATION = str(shipped_file("cfrpmt.yaml"))


def guard(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["guard", "--config", CONFIGURATION, *map(str, arguments)])


def test_prints_the_programs_of_the_machine() -> None:
    printed = guard()
    assert printed.exit_code == 0
    assert "(MACHINE CFRP MACHINE TOOL)" in printed.output
    assert set(compile_programs(printed.output)) == {9010, 9011, 9012}


def test_the_sheet_of_a_sinumerik_speaks_of_its_own_things(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.md"
    assert guard("--dialect", "sinumerik", "--sheet", sheet).exit_code == 0
    text = sheet.read_text("utf-8")
    for words in ("| start | TP9015 |", "SD43900", "MD32750", "$AC_TIMER[1] plus 60", "never on a SINUMERIK"):
        assert words in text, words
    assert not any(words in text for words in ("#", "G65P", "EXT", "FANUC")[1:]) and "#5" not in text


@pytest.mark.parametrize("suffix,beginning", [(".html", "<!doctype html>"), (".md", "# Commissioning sheet")])
def test_writes_the_sheet(tmp_path: Path, suffix: str, beginning: str) -> None:
    sheet = tmp_path / f"sheet{suffix}"
    assert guard("--sheet", sheet).exit_code == 0
    text = sheet.read_text("utf-8")
    assert text.startswith(beginning)
    assert "Released for production by" in text
    assert guard("--sheet", sheet).exit_code == 2


@pytest.mark.parametrize(
    "arguments,sentence",
    [
        (("--sheet", "sheet.pdf"), "the sheet is .html or .md"),
        (("--sheet", "a.md", "--output", "b.nc"), "give one of them"),
        (("--program", 9999), "less than or equal to 9995"),
        (("--program", 0), "greater than or equal to 1"),
        (("--policy", "retreat"), "'keep', 'zero'"),
    ],
)
def test_bad_usage_is_refused_in_a_sentence(arguments: tuple[object, ...], sentence: str) -> None:
    refused = guard(*arguments)
    assert refused.exit_code == 2
    assert sentence in refused.output
    assert "Traceback" not in refused.output


def test_axes_that_nobody_can_tell_are_asked_for(tmp_path: Path) -> None:
    text = (
        shipped_file("cfrpmt.yaml").read_text("utf-8").replace("{x: 501, y: 502, z: 503}", "{u: 501, y: 502, z: 503}")
    )
    text = text.replace("{x: 511, y: 512, z: 513}", "{u: 511, y: 512, z: 513}").replace("\n    x:\n", "\n    u:\n")
    changed = tmp_path / "toolpoint.yaml"
    changed.write_text(text, encoding="utf-8")
    refused = CliRunner().invoke(main, ["guard", "--config", str(changed)])
    assert refused.exit_code == 2
    assert "cnc.guard.axes: u is not x, y or z" in refused.output
