"""Keys with a new name work under the old one for a version, with a warning at their place."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from config.loader import ConfigurationError, load_configuration, load_with_warnings
from config.sample import sample_configuration
from config.yaml_document import move_renamed_keys, read_yaml


def written(tmp_path: Path, **cnc: Any) -> Path:
    """Return the sample as a file, with changes in the section of the CNC."""
    content = yaml.safe_load(sample_configuration())
    for key, value in cnc.items():
        content["cnc"][key] |= value
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def without_new_keys(path: Path) -> None:
    """Take the new keys out, as a file of the version before has them not."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    del content["cnc"]["allow_insecure_writes"], content["cnc"]["guard"]["max_validity_s"], content["cnc"]["driver"]
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def line_of(path: Path, key: str) -> int:
    lines = path.read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, start=1) if line.strip().startswith(f"{key}:"))


def test_a_file_of_the_version_before_is_read_with_a_warning_for_each_old_key(tmp_path: Path) -> None:
    path = written(tmp_path, opcua={"allow_insecure_writes": True}, guard={"look_ahead_s": 150.0})
    without_new_keys(path)
    configuration, warnings = load_with_warnings(path)
    assert configuration.cnc.driver == "opcua"
    assert configuration.cnc.allow_insecure_writes
    assert configuration.cnc.guard.max_validity_s == 150.0
    assert [str(warning) for warning in warnings] == [
        f"{path}:{line_of(path, 'allow_insecure_writes')}:5: cnc.opcua.allow_insecure_writes: "
        "write `cnc.allow_insecure_writes`; the old name works in this version only",
        f"{path}:{line_of(path, 'look_ahead_s')}:5: cnc.guard.look_ahead_s: "
        "write `cnc.guard.max_validity_s`; the old name works in this version only",
    ]


def test_a_file_that_gives_both_names_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, guard={"look_ahead_s": 150.0})
    with pytest.raises(ConfigurationError) as refused:
        load_configuration(path)
    (problem,) = refused.value.problems
    assert str(problem) == (
        f"{path}:{line_of(path, 'look_ahead_s')}:5: cnc.guard.look_ahead_s: the old name of "
        f"`cnc.guard.max_validity_s`, which stands in line {line_of(path, 'max_validity_s')} too: remove this one"
    )


def test_what_is_refused_under_an_old_name_is_refused_at_its_place(tmp_path: Path) -> None:
    path = written(tmp_path, guard={"look_ahead_s": -1.0})
    without_new_keys(path)
    with pytest.raises(ConfigurationError) as refused:
        load_configuration(path)
    (problem,) = refused.value.problems
    assert (problem.line, problem.column) == (line_of(path, "look_ahead_s"), 19)
    assert (problem.key, problem.sentence) == ("cnc.guard.max_validity_s", "this must be at least 0.001, not -1.0")


def test_a_whole_section_moves_with_the_places_below_it_and_through_aliases() -> None:
    document = read_yaml("base: &b\n  old: {a: 1}\nx:\n  <<: *b\ny: {}\n")
    (warning,) = move_renamed_keys(document, {"x.old": "y.new"})
    assert document.value == {"base": {"old": {"a": 1}}, "x": {}, "y": {"new": {"a": 1}}}
    assert (warning.position, warning.path) == ((2, 3), ("x", "old"))
    assert document.keys[("y", "new", "a")] == (2, 9)
    assert ("x", "old") not in document.keys
