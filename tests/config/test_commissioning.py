"""The commissioning record: what it must prove, how it is kept, and what it permits."""

import hashlib
import json
import stat

import pytest
from pydantic import ValidationError
from shipped_machine import shipped_machine

from config.machines import shipped_file
from config.records.commissioning import (
    AxisReadings,
    CommissionedAxis,
    CommissioningError,
    CommissioningRecord,
    commissioning_inhibit,
    load_commissioning,
    macro_map_digest,
)
from config.records.commissioning_file import save_commissioning
from daemon.commissioning.report import record_digest
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.sim.nc.safe_point import GUARD_VERSION

MACROS = shipped_machine().cnc.macros
READINGS = {"source": "read by the person", "before_um": 0.2, "at_offset_um": 5.1, "after_um": 0.0}


def axis(**changes) -> CommissionedAxis:
    content = {
        "sign": 1,
        "scale": 1.0,
        "written_um": 5.0,
        "measured_um": 5.0,
        "readings": AxisReadings(**READINGS),
        "others_um": {"x": 0.1},
    }
    return CommissionedAxis(**(content | changes))


def record(**changes) -> CommissioningRecord:
    content = {
        "cnc_identity": "urn:cnc",
        "macro_map_sha256": macro_map_digest(MACROS),
        "guard_version": 3,
        "person": "A. Fitter",
        "date": "2026-01-31",
        "axes": {"z": axis()},
    }
    return CommissioningRecord(**(content | changes))


def inhibit(of: CommissioningRecord | None, **changes) -> str:
    content = {"cnc_identity": "urn:cnc", "macros": MACROS, "axes": ["z"], "guard_version": 3.0}
    return commissioning_inhibit(of, **(content | changes))


def test_the_record_of_a_sister_whose_control_calls_itself_alike_permits_nothing():
    """An OPC UA server's application URI is that of the type, and records travel with copied configurations."""
    assert inhibit(record(machine="mill 1"), machine="mill 1") == inhibit(record(), machine="mill 1") == ""
    assert "of machine 'mill 1', this one is 'mill 2'" in inhibit(record(machine="mill 1"), machine="mill 2")


def test_a_record_survives_the_way_over_the_disk(tmp_path):
    path = tmp_path / "record.json"
    path.write_text("an old one", encoding="utf-8")
    save_commissioning(record(), path)
    assert load_commissioning(path) == record()
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert [entry.name for entry in tmp_path.iterdir()] == ["record.json"]


def test_the_digest_on_paper_is_that_of_the_file(tmp_path):
    path = tmp_path / "record.json"
    save_commissioning(record(), path)
    assert record_digest(record()) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_record_that_cannot_be_written_leaves_the_old_one(tmp_path):
    with pytest.raises(CommissioningError, match="cannot be written"):
        save_commissioning(record(), tmp_path / "nowhere" / "record.json")
    folder = tmp_path / "record.json"
    folder.mkdir()
    with pytest.raises(CommissioningError, match="cannot be written"):
        save_commissioning(record(), folder)
    assert [entry.name for entry in tmp_path.iterdir()] == ["record.json"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"written_um": 1.0, "measured_um": 1.0, "readings": None}, "too small to prove"),
        ({"measured_um": 3.9, "readings": None}, "3.9 um were measured"),
        ({"measured_um": 4.5}, "the readings make a movement of 5 um"),
        ({"sign": 0}, "sign"),
        ({"scale": 25.4}, "scale"),
    ],
)
def test_an_axis_that_proves_nothing_is_no_record(changes, words):
    with pytest.raises(ValidationError, match=words):
        axis(**changes)


def test_a_record_of_format_2_names_its_guard(tmp_path):
    with pytest.raises(ValidationError, match="guard_version is missing"):
        record(guard_version=None)
    path = tmp_path / "record.json"
    path.write_text(json.dumps(record().model_dump(mode="json") | {"guard_version": None}), encoding="utf-8")
    with pytest.raises(CommissioningError, match="guard_version is missing"):
        load_commissioning(path)


def test_what_is_wrong_with_a_record_is_a_sentence(tmp_path):
    path = tmp_path / "record.json"
    content = record().model_dump_json()
    path.write_text(content.replace('"sign":1', '"sign":-1'), encoding="utf-8")
    with pytest.raises(CommissioningError, match=r"record\.json: axes.z: sign and scale make"):
        load_commissioning(path)
    path.write_text(content[:-9], encoding="utf-8")
    with pytest.raises(CommissioningError, match=r"record\.json: Invalid JSON: EOF"):
        load_commissioning(path)


def test_an_old_record_is_read_and_permits_nothing_once_the_guard_has_spoken():
    old = record(format_version=1, guard_version=None)
    assert inhibit(old, guard_version=None) == ""
    assert "format 1 and does not say which guard" in inhibit(old)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cnc_identity": "urn:other"}, "this control is 'urn:other'"),
        ({"axes": ["y", "z"]}, "not commissioned: axis y"),
        ({"guard_version": 4.0}, "runs guard version 4, the commissioning was made with version 3"),
        ({"guard_version": 3.5}, "runs guard version 3.5"),
        ({"macros": MACROS.model_copy(update={"unit_um": 1.0})}, "macro map has changed"),
    ],
)
def test_what_the_record_does_not_cover_is_refused_with_what_to_do(changes, words):
    said = inhibit(record(), **changes)
    assert words in said and "toolpoint commission" in said


def test_what_the_record_covers_is_permitted():
    assert inhibit(record()) == ""
    assert "no commissioning record" in inhibit(None)


@pytest.mark.parametrize("heard", [None, 1.0, 2.0])
def test_a_guard_that_makes_no_check_is_not_accepted(heard: float | None) -> None:
    said = inhibit(record(guard_version=1), guard_version=heard)
    assert "guard version 1, which applies a block whose check does not fit: load the text that" in said
    assert "run `toolpoint commission` again" in said


def test_the_shipped_record_is_that_of_the_simulated_machine():
    shipped = load_commissioning(shipped_file("simulated_machine_commissioning.json"))
    assert shipped.format_version == 2
    said = commissioning_inhibit(
        shipped,
        cnc_identity=SIMULATED_CNC_IDENTITY,
        macros=MACROS,
        axes=["x", "y", "z"],
        guard_version=float(GUARD_VERSION),
    )
    assert said == ""


@pytest.mark.parametrize("content", [b"", b'{"axes": '])
def test_a_record_that_is_not_whole_is_refused_in_one_clause(tmp_path, content):
    path = tmp_path / "commissioning.json"
    path.write_bytes(content)
    with pytest.raises(CommissioningError, match=rf"^{path}: Invalid JSON"):
        load_commissioning(path)
