"""The parts of a commissioning that need no machine: judgement, report, dialogue, and the command's words."""

import asyncio
import json
import os
import re
from html.parser import HTMLParser

import pytest
import yaml
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from shipped_machine import shipped_machine
from terminal import Terminal

from config.machines import shipped_file
from config.records.commissioning import (
    PROOF_TOLERANCE,
    AxisReadings,
    CommissionedAxis,
    CommissioningRecord,
    macro_map_digest,
)
from daemon.cli.admin.commission import commission
from daemon.commissioning.dialogue import TerminalDialogue
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.judgement import judge
from daemon.commissioning.readings import Instruments, Moment, Reading
from daemon.commissioning.report import record_digest, report_html

CONFIGURATION = shipped_machine()


def taken(before: float, at_offset: float, after: float, noise: float | None = None, **others: float):
    readings = {}
    for moment, um in zip(Moment, (before, at_offset, after), strict=True):
        readings[moment] = {"z": Reading(um=um, source="channel Z1", noise_um=noise, samples=5)}
        for axis, moved in others.items():
            readings[moment][axis] = Reading(um=moved if moment is Moment.AT_OFFSET else 0.0, source="eyes")
    return readings


# --- judgement -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("readings", "words"),
    [
        (taken(0.0, -5.0, 0.0), "doubles the error"),
        (taken(0.0, 0.3, 0.0), "moved by 0.30 um"),
        (taken(0.0, 127.0, 0.0), "25.4"),
        (taken(0.0, 5000.0, 0.0), "1000"),
        (taken(0.0, 10.0, 0.0), "diameter"),
        (taken(0.0, 2.5, 0.0), "radius"),
        (taken(0.0, 7.0, 0.0), "No usual cause"),
        (taken(0.0, 5.0, 2.0), "drifts"),
        (taken(0.0, 5.0, 0.0, 0.8), "scatters by 0.80 um"),
        (taken(0.0, 5.0, 0.0, y=-2.0), "axis y by -2.00 um moved as well"),
        (taken(0.0, 0.0, 0.0, y=-5.0, x=0.1), "axis y by -5.00 um instead"),
    ],
)
def test_what_proves_nothing_is_refused_with_its_cause(readings, words):
    with pytest.raises(CommissioningRefusedError) as error:
        judge("z", 5.0, readings)
    assert words in str(error.value) and "axis z" in str(error.value)


def test_a_steady_drift_is_taken_out():
    found = judge("z", 5.0, taken(10.0, 15.4, 10.8))
    assert (found.sign, found.scale, found.measured_um) == (1, 1.0, 5.0)


def test_a_scale_outside_every_machine_is_not_accepted_by_anybody():
    with pytest.raises(CommissioningRefusedError, match=r"25\.4"):
        judge("z", 5.0, taken(0.0, 127.0, 0.0), accept_scale=True)
    assert judge("z", 5.0, taken(0.0, 10.0, 0.0), accept_scale=True).scale == 2.0


@settings(max_examples=100, deadline=None)
@given(
    offset_um=st.floats(2.0, 100.0).flatmap(lambda um: st.sampled_from([um, -um])),
    ratio=st.floats(-3.0, 3.0),
    zero_um=st.floats(-1e3, 1e3),
)
def test_only_a_right_movement_passes(offset_um, ratio, zero_um):
    readings = taken(zero_um, zero_um + ratio * offset_um, zero_um)
    try:
        found = judge("z", offset_um, readings)
    except CommissioningRefusedError:
        assert abs(ratio - 1.0) > PROOF_TOLERANCE - 1e-3
    else:
        assert abs(ratio - 1.0) < PROOF_TOLERANCE + 1e-3
        assert (found.sign, found.scale) == (1, 1.0)


# --- report ----------------------------------------------------------------------------


def record(**changes) -> CommissioningRecord:
    readings = AxisReadings(
        source="<img src=x onerror=alert(1)>", before_um=0.0, at_offset_um=4.9, after_um=0.0, noise_um=0.1, samples=9
    )
    proved = CommissionedAxis(
        sign=1, scale=1.0, written_um=5.0, measured_um=4.9, readings=readings, others_um={"x": 0.05}
    )
    content = {
        "cnc_identity": "urn:cnc?a=1&b=2",
        "macro_map_sha256": macro_map_digest(CONFIGURATION.cnc.macros),
        "guard_version": 2,
        "person": "<script>alert('Fitter')</script>",
        "date": "2026-01-31",
        "machine": 'the "big" one',
        "instrument": "indicator </td>",
        "axes": {"z": proved, "y": proved},
    }
    return CommissioningRecord(**(content | changes))


class Page(HTMLParser):
    """Collects tags, attributes and text; complains about tags that do not close."""

    VOID = ("meta", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_the_report_is_whole_and_harmless():
    text = report_html(record(), CONFIGURATION)
    page = Page(text)
    assert not {"script", "img", "link", "iframe", "object"} & set(page.tags)
    assert not [name for name, _ in page.attributes if name in ("src", "href") or name.startswith("on")]
    assert not re.search(r"url\(|@import", text)
    for words in (
        "<script>alert('Fitter')</script>",
        "urn:cnc?a=1&b=2",
        "indicator </td>",
        "<img src=x onerror=alert(1)>",
        "4.90",
        "0.10 (9)",
        "#503",
        "signature",
        "another control",
        record_digest(record()),
    ):
        assert words in page.text, words
    assert "does not fit" not in page.text


# --- dialogue --------------------------------------------------------------------------


@pytest.fixture
def terminal():
    with Terminal() as terminal:
        yield terminal


async def asked(capsys, asking, *lines, answer):
    """Ask; answer each time the question is shown, as `answer` does it; return what was understood."""
    waiting, shown = asyncio.create_task(asking), ""
    for line in lines:
        while "? " not in (piece := capsys.readouterr().out):
            shown += piece
            await asyncio.sleep(0)
            assert not waiting.done(), "nobody has answered"
        shown += piece
        answer(line)
    return await waiting, shown + capsys.readouterr().out


async def test_answers_are_read_line_by_line(capsys):
    reading, writing = os.pipe()
    dialogue = TerminalDialogue(consent=False, descriptor=reading)

    async def heard(asking, *lines):
        return await asked(capsys, asking, *lines, answer=lambda line: os.write(writing, line))

    found, said = await heard(dialogue.confirm("go?"), b"maybe\n", b"y\n")
    assert found is True and "answer y or n" in said
    assert (await heard(dialogue.confirm("go?"), b"no\n"))[0] is False
    assert (await heard(dialogue.confirm("go?"), b"\n"))[0] is False
    found, said = await heard(dialogue.number("um?"), b"five\n", b"4,5\n")
    assert found == 4.5 and "'five' is no number" in said
    assert (await heard(dialogue.number("um?"), b"-0.2\n"))[0] == -0.2
    assert (await heard(dialogue.number("um?"), b"\n"))[0] is None
    assert (await heard(dialogue.text("name?"), b"Dr. \xc3\xa4\n"))[0] == "Dr. ä"
    os.close(writing)
    with pytest.raises(CommissioningRefusedError, match="standard input has ended"):
        await dialogue.text("name?")
    os.close(reading)


async def test_readings_that_were_typed_before_they_were_asked_for_do_not_count(capsys, terminal):
    dialogue = TerminalDialogue(consent=False, descriptor=terminal.inside)
    terminal.type_ahead("0.2\n2.3\n0.25\n")
    for um in (0.1, 4.9, 0.0):
        found, said = await asked(capsys, dialogue.number("um?"), f"{um}\n7\n8", answer=terminal.type)
        assert found == um
        assert "What was typed before this question does not count." in said


async def test_a_confirmation_that_was_typed_before_its_question_is_none(capsys, terminal):
    dialogue = TerminalDialogue(consent=False, descriptor=terminal.inside)
    terminal.type_ahead("y\ny\n")
    assert (await asked(capsys, dialogue.confirm("overwrite?"), "n\n", answer=terminal.type))[0] is False


async def test_general_consent_covers_steps_but_no_foreign_values():
    dialogue = TerminalDialogue(consent=True)
    assert await dialogue.confirm("go?") is True
    assert await dialogue.confirm_expressly("overwrite?") is False
    assert await dialogue.number("um:") is None


# --- the command -----------------------------------------------------------------------


def machine_file(tmp_path, **compensation):
    content = yaml.safe_load(shipped_file("cfrpmt.yaml").read_text(encoding="utf-8"))
    content["cnc"]["opcua"] = {"endpoint": "opc.tcp://127.0.0.1:9/x", "namespace_uri": "urn:toolpoint:cnc"}
    content["history"] = {"path": str(tmp_path / "history.sqlite")}
    content["service"] = {"socket": str(tmp_path / "s"), "http_port": None}
    content["compensation"] |= compensation
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def run(*arguments):
    return CliRunner().invoke(commission, [str(argument) for argument in arguments])


def test_check_says_what_a_record_does_not_cover(tmp_path):
    content = json.loads(shipped_file("simulated_machine_commissioning.json").read_text(encoding="utf-8"))
    del content["axes"]["y"]
    content["machine"] = "CFRP machine tool"
    record_file = tmp_path / "record.json"
    record_file.write_text(json.dumps(content), encoding="utf-8")
    found = run("--config", machine_file(tmp_path), "--check", "--record", record_file)
    assert found.exit_code == 1 and "not commissioned: axis y" in found.output
    record_file.write_text("{}", encoding="utf-8")
    found = run("--config", machine_file(tmp_path), "--check", "--record", record_file)
    assert found.exit_code == 1 and "record.json" in found.output


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--axis", "w", "--record", "R"], 2, "there is no axis w"),
        (["--reading", "z=1,2", "--record", "R"], 2, "three numbers"),
        (["--reading", "z=1,nan,2", "--record", "R"], 2, "finite"),
        (["--channel", "z", "--record", "R"], 2, "AXIS="),
        (["--channel", "z=A", "--channel", "z=B", "--record", "R"], 2, "twice"),
        (["--channel", "z=Y1", "--record", "R"], 2, "Y1 is the thermal error of axis y"),
        ([], 2, "no place for the record"),
        (["--reading", "z=0,5,0", "--yes", "--record", "R"], 2, "--yes does not cover --reading"),
        (["--record", "nowhere/record.json", "--yes", "--person", "A"], 1, "there is no folder"),
        (["--record", "R", "--yes"], 1, "give --person"),
        (["--record", "R", "--yes", "--person", "A"], 1, "unencrypted, anonymous connection"),
        (["--check"], 2, "there is no record"),
        (["--secrets", ".", "--record", "R"], 2, "cnc.opcua.security is not configured"),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_is_touched(tmp_path, monkeypatch, arguments, status, words):
    monkeypatch.chdir(tmp_path)
    found = run("--config", machine_file(tmp_path), *arguments)
    assert found.exit_code == status and words in found.output, found.output
    assert not (tmp_path / "R").exists()


def test_without_a_model_no_axis_is_moved_unless_it_is_named(tmp_path):
    configured = machine_file(tmp_path)
    content = yaml.safe_load(configured.read_text(encoding="utf-8"))
    for axis in content["compensation"]["axes"].values():
        axis.pop("estimate", None)
        axis.pop("tool_term", None)
    configured.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    found = run("--config", configured, "--record", tmp_path / "R", "--yes", "--person", "A")
    assert found.exit_code == 2 and "no axis has a model yet" in found.output
    found = run("--config", configured, "--record", tmp_path / "R", "--yes", "--person", "A", "--axis", "z")
    assert found.exit_code == 1 and "unencrypted, anonymous connection" in found.output


async def test_a_reading_given_beforehand_counts_only_once_a_person_has_seen_it(capsys, terminal):
    given = {("z", "z"): (0.0, 5.0, 0.0)}

    def instruments(dialogue):
        return Instruments(dialogue, log=None, channels={}, given=given, samples=2, patience_s=1.0)

    seen = instruments(TerminalDialogue(consent=False, descriptor=terminal.inside))
    taken, _ = await asked(capsys, seen.take("z", Moment.BEFORE, ("z",)), "y\n", answer=terminal.type)
    assert taken["z"].um == 0.0
    with pytest.raises(CommissioningRefusedError, match="no person has confirmed 5 um with the offset applied"):
        await asked(capsys, seen.take("z", Moment.AT_OFFSET, ("z",)), "n\n", answer=terminal.type)
    with pytest.raises(CommissioningRefusedError, match="no person has confirmed 0 um"):
        await instruments(TerminalDialogue(consent=True)).take("z", Moment.BEFORE, ("z",))
