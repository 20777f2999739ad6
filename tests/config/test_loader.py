"""Configuration files: every error with file, line, column and key; nothing read as something else."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from config.loader import ConfigurationError, load_configuration, load_yaml_model, parse_yaml_model
from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.base import Section
from config.schema.cnc_drivers import OpcUaConfig
from config.yaml_document import read_yaml


class Part(Section):
    """A part for tests."""

    name: str = Field(description="what it is called")
    count: int = 1
    length_mm: float = 1.0
    on: bool = False


class Whole(Section):
    """A whole for tests."""

    title: str
    parts: list[Part] = Field(default_factory=list)
    named: dict[str, Part] = Field(default_factory=dict)
    numbers: list[int | str] = Field(default_factory=list)


def problems(text: str, model: type[Section] = Whole) -> list[str]:
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, model, "f.yaml")
    return [str(problem) for problem in refused.value.problems]


@pytest.mark.parametrize("key", ["port", "tls", "ca_certificate"])
def test_a_text_in_a_wrong_key_is_not_shown_where_a_password_may_have_been_meant(key: str) -> None:
    typed = "[hunter2]" if key == "ca_certificate" else "hunter2"
    sink = f"mqtt: {{host: b, {key}: {typed}, user_name: a, password_file: /f}}"
    (found,) = problems(f"{sample_configuration()}\nsinks:\n  - {{name: s, driver: mqtt, {sink}}}\n", Configuration)
    assert f"sinks[0].mqtt.{key}: this must be" in found and "hunter2" not in found
    assert ("a text, which is not shown" in found) is (key != "ca_certificate")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("title: x\npart: []", ["f.yaml:2:1: part: unknown key; did you mean `parts`?"]),
        ("title: x\nzzz: 1", ["f.yaml:2:1: zzz: unknown key; known here: title, parts, named, numbers"]),
        ("title: x\ntitle: y", ["f.yaml:2:1: title: this key stands already in line 1; keep one of them"]),
        ("title: 5", ["f.yaml:1:8: title: this must be text, not 5"]),
        (
            "title: x\nparts:\n  - name: a\n    count: 1.5",
            ["f.yaml:4:12: parts[0].count: this must be a whole number, not 1.5"],
        ),
        (
            'title: x\nparts: [{name: a, length_mm: "3"}]',
            ["f.yaml:2:30: parts[0].length_mm: this must be a number, not the text '3'"],
        ),
        (
            "title: x\nparts:\n  - name: a\n    length_mm: 0,5",
            ["f.yaml:4:16: parts[0].length_mm: this must be a number, not the text '0,5': write it with a point, 0.5"],
        ),
        (
            "title: x\nparts: [{name: a, on: yes}]",
            [
                "f.yaml:2:23: parts[0].on: `yes` could be a word or a truth value; "
                "write true or false, or put the word in quotes"
            ],
        ),
        (
            "title: x\nparts:\n  - count: 3",
            ["f.yaml:3:5: parts[0].name: this key is required and missing: what it is called"],
        ),
        (
            "title: x\nnamed:\n  first:\n    count: 3",
            ["f.yaml:3:3: named.first.name: this key is required and missing: what it is called"],
        ),
        ("title: x\nparts: {a: 1}", ["f.yaml:2:1: parts: this must be a list, not keys with values"]),
        ("title: x\nnumbers: [1.5]", ["f.yaml:2:11: numbers[0]: this must be a whole number or text, not 1.5"]),
        ("title:", ["f.yaml:1:7: title: this must be text, not nothing"]),
        ("title: !!str 5", ["f.yaml:1:8: the tag !!str is refused; write the plain value, in quotes if it is text"]),
        ("title: !python/name:os.system x", ["f.yaml:1:8: the tag !python/name:os.system is refused; "]),
        ("- 1", ["f.yaml:1:1: must be keys with values, not a list"]),
        ("url:mqtt://anna:hunter2@b", ["f.yaml:1:1: must be keys with values, not the text '***@b'"]),
        (
            f"title: x\nparts: s3://KEY:{'hunter2' * 9}@bucket",
            ["f.yaml:2:8: parts: this must be a list, not the text 's3://***@bucket'"],
        ),
        (
            "title: x\nparts: host=h password='hunter 2' user=a",
            ["f.yaml:2:8: parts: this must be a list, not the text 'host=h password=*** user=a'"],
        ),
        ("title: x\nanna:hunter2@b: 1", ["f.yaml:2:1: ***@b: unknown key"]),
        ("just words", ["f.yaml:1:1: must be keys with values, not the text 'just words'"]),
        ("", ["f.yaml:1:1: the file is empty"]),
        ("# only a comment\n", ["f.yaml:1:1: the file is empty"]),
        ("title: x\n\tparts: []", ["f.yaml:2:1: a tab may not stand here; indent with blanks"]),
        ("title: [x\nparts: 1", ["f.yaml:2:6: the list or mapping in brackets that begins in line 1 does not end"]),
        ("title: x\n---\ntitle: y", ["f.yaml:2:1: a second document begins here, and the file may hold one; remove"]),
        ("title: *nobody", ["f.yaml:1:8: a text that begins with * needs quotes"]),
        ("title: @home", ["f.yaml:1:8: a text that begins with @ needs quotes"]),
        ('title: "x\nparts: []', ["f.yaml:2:10: the quote that begins in line 1 does not end"]),
        ("title x\nparts: []", ["f.yaml:2:6: a key may not stand here: the line above lacks its colon, or"]),
        ("title: x: y", ["f.yaml:1:9: a key may not stand here: the line above lacks its colon, or"]),
        ("parts:\n  - name: a\n count: 3", ["f.yaml:3:2: this line is indented otherwise than the lines of its"]),
        ("title: x\nparts", ["f.yaml:2:6: a key must stand here, and its colon is missing; or a line above"]),
        ("title: &a &b x", ["f.yaml:1:11: this is not valid YAML: "]),
        ("title: a\0b", ["f.yaml:1:9: the character U+0000 may not stand in YAML; remove it"]),
        ('title: "\\ud800"', ["f.yaml:1:8: title: the text holds U+D800, which is no character"]),
        (
            'title: "a\\0b"',
            ["f.yaml:1:8: title: the text holds U+0000, which is no character of a text; remove the escape"],
        ),
        ('title: "\\e[2J"', ["f.yaml:1:8: title: the text holds U+001B, which is no character"]),
        ('title: x\n"\\ud800": 1', ["f.yaml:2:1: a key holds U+D800, which is no character"]),
        ("[a]: 1\ntitle: x", ["f.yaml:1:1: a key must be a word, not a list or a mapping"]),
        ("title: x\nnamed: &n\n  a: *n", ["f.yaml:2:8: named.a: the alias contains itself; write the value out"]),
        ("title: x\nnamed:\n  <<: 5", ["f.yaml:3:7: named: `<<` takes a mapping"]),
    ],
)
def test_each_refusal_names_its_place_and_what_to_do(text: str, expected: list[str]) -> None:
    found = problems(text)
    assert len(found) == len(expected)
    for line, beginning in zip(found, expected, strict=True):
        assert line.startswith(beginning)


@pytest.mark.parametrize(
    "number",
    ["017", "00", "0x1F", "0o17", "0b11", "1_000", "1:30", "-010", ".nan", ".inf", "-.INF", "1e999", "9" * 60, "1_0.5"],
)
def test_numbers_that_readers_disagree_on_are_refused(number: str) -> None:
    found = problems(f"title: x\nparts: [{{name: a, length_mm: {number}}}]")
    assert len(found) == 1
    assert found[0].startswith("f.yaml:2:30: parts[0].length_mm: ")
    assert number in found[0] or "60 characters" in found[0]


def test_everything_wrong_is_said_at_once_and_in_order() -> None:
    text = "titl: 1\nparts:\n  - {nam: a, count: x}\n  - {name: b, on: off}\nnumbers: 3\n"
    found = problems(text)
    assert [line.split(": ")[1] for line in found] == [
        "titl",
        "title",
        "parts[0].name",
        "parts[0].nam",
        "parts[0].count",
        "parts[1].on",
        "numbers",
    ]
    assert [tuple(map(int, line.split(":")[1:3])) for line in found] == sorted(
        tuple(map(int, line.split(":")[1:3])) for line in found
    )


@pytest.mark.parametrize(
    ("written", "value"),
    [("1e-6", 1e-6), ("1E5", 1e5), ("+3", 3.0), ("-0.5", -0.5), (".5", 0.5), ("2.", 2.0), ("7", 7.0), ("0", 0.0)],
)
def test_numbers_as_people_write_them(written: str, value: float) -> None:
    whole = parse_yaml_model(f"title: x\nparts: [{{name: a, length_mm: {written}}}]", Whole, "f.yaml")
    assert whole.parts[0].length_mm == value


def test_dates_ranges_and_quoted_words_are_text() -> None:
    text = "title: 2026-01-31\nnumbers: [7-12, 'yes', \"017\", 12, 10.0.0.1]\nnamed: {no: {name: 'on'}, 5: {name: x}}"
    whole = parse_yaml_model(text, Whole, "f.yaml")
    assert whole.title == "2026-01-31"
    assert whole.numbers == ["7-12", "yes", "017", 12, "10.0.0.1"]
    assert list(whole.named) == ["no", "5"]
    assert whole.named["no"].name == "on"


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    missing = tmp_path / "missing.yaml"
    with pytest.raises(ConfigurationError, match=r"missing\.yaml: cannot be read: No such file"):
        load_yaml_model(missing, Whole)
    with pytest.raises(ConfigurationError, match="cannot be read: Is a directory"):
        load_yaml_model(tmp_path, Whole)
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("title: x\nparts: [ä".encode("latin-1"))
    with pytest.raises(ConfigurationError, match=r"latin\.yaml:2:9: the byte 0xE4 is not UTF-8"):
        load_yaml_model(latin, Whole)


def test_a_file_that_is_too_large_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.write(b"title: ")
        file.truncate(50_000_000)
    with pytest.raises(ConfigurationError, match="is larger than 1 MiB, more than any description needs"):
        load_yaml_model(path, Whole)
    with pytest.raises(ConfigurationError, match="is larger than 1 MiB"):
        load_yaml_model(Path("/dev/zero"), Whole)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("title: " + "x" * 10_001, "f.yaml:1:8: title: the text has 10001 characters; at most 10000 are read"),
        ("title: x\n? " + "k" * 10_001 + "\n: 1", "f.yaml:2:3: a key has 10001 characters; at most 10000 are read"),
    ],
)
def test_a_text_that_is_too_long_is_refused_with_its_place(text: str, problem: str) -> None:
    assert problems(text) == [problem]


def test_relative_paths_start_at_the_files_folder(tmp_path: Path) -> None:
    content = yaml.safe_load(sample_configuration())
    content["compensation"]["model_file"] = "models/z.json"
    content["history"]["path"] = "/srv/history.sqlite"
    content["cnc"]["opcua"]["security"] = {
        "user_name": "u",
        "password_file": "secret",
        "certificate": "../own.der",
        "private_key": "own.pem",
        "server_certificate": "cnc.der",
    }
    content["displacements"] = {"file": {"path": "logs/*.csv"}, "channels": [{"name": "Z1", "column": 2}]}
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    configuration = load_configuration(path)
    security = configuration.cnc.connection_as(OpcUaConfig).security
    assert configuration.compensation.model_file == tmp_path / "models/z.json"
    assert configuration.history.path == Path("/srv/history.sqlite")
    assert security is not None
    assert security.password_file == tmp_path / "secret"
    assert security.certificate == tmp_path / "../own.der"
    assert configuration.displacements is not None
    assert configuration.displacements.file.path == tmp_path / "logs/*.csv"
    assert configuration.compensation.commissioning_file is None


# The writer leaves words such as 08 and 1e3 without quotes, as YAML 1.1 may; no reader could tell them from numbers.
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12).filter(
    lambda word: not re.match(r"[-+.]*[0-9]", word)
)
values: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.floats(allow_nan=False, allow_infinity=False) | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=4),
    max_leaves=12,
)


@settings(deadline=None)
@given(values)
def test_what_a_yaml_writer_wrote_is_read_as_it_was_meant(value: Any) -> None:
    document = read_yaml(yaml.safe_dump(value, allow_unicode=True))
    assert not document.faults
    assert document.value == value


@given(st.text(max_size=200))
def test_any_text_ends_in_problems_with_places_inside_the_text(text: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, Whole, "f.yaml")
    assert refused.value.problems
    for problem in refused.value.problems:
        assert 1 <= problem.line <= text.count("\n") + text.count("\r") + len(text.splitlines()) + 1
        assert problem.column >= 1
        assert problem.sentence


SECTIONS = re.split(r"(?m)^(?=\w)", sample_configuration())
"""Each is valid YAML, and read far sooner than the whole."""


@settings(deadline=None)
@given(st.data())
def test_a_sample_with_one_character_changed_never_ends_in_another_error(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from(SECTIONS))
    position = data.draw(st.integers(0, len(text) - 1))
    character = data.draw(st.sampled_from("\0\t\n :-#'\"{}[]&*!|>%@x0é"))
    changed = text[:position] + character + text[position + 1 :]
    try:
        parse_yaml_model(changed, Whole, "f.yaml")
    except ConfigurationError as error:
        assert error.problems
    else:
        pytest.fail("the sample is no Whole")
