"""What is kept for the next start: typed, with a version, and as the version before wrote it."""

import json
import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import pytest
from control_rig import EPOCH_S, HandClock, machine

from daemon.estimation.sensor_memory import LevelMemory
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import (
    DaemonAlive,
    OperationSpeed,
    OutputFault,
    SensorLevelsDocument,
    SpindleSpeeds,
    SpindleSpeedSwitch,
    WantedAxes,
)
from daemon.state_store.store import FORMAT_VERSION, KEYS, DocumentError, StateStore, document_json, from_json, to_json
from models.control.reference_records import CncSeen, ReferenceDocument, ReferenceState, ToolOrigin
from models.records import FloatArray, Instant
from models.sensor_levels import GAPS_KEPT, unshifted, with_gap

SPEED = {"key": [1.0, 9e3, 1.8e3, 2.0, 0.0, 1.0, -1.0], "programmed_rpm": 9e3, "commanded_rpm": 10175.1, "moved": True}
DOCUMENTS = [
    DaemonAlive(utc_s=1.5e9),
    WantedAxes(axes={"x": False, "z": True}),
    OutputFault(reasons=("first", "second")),
    OutputFault(reasons=()),
    SpindleSpeedSwitch(off_by="Ada (uid 7)"),
    SpindleSpeeds(operations=(OperationSpeed(**SPEED | {"key": tuple(SPEED["key"]), "utc_s": 1.5e9}),)),
]
WRITTEN_BY_0_1_0 = [
    ("alive_utc_s", 1760009660.0, DaemonAlive(utc_s=1760009660.0)),
    ("wanted", {"x": False, "z": True}, DOCUMENTS[1]),
    ("fault", None, None),
    ("fault", "read-back differs: a; b", OutputFault(reasons=("read-back differs: a; b",))),
    ("spindle_speed_off", "", SpindleSpeedSwitch(off_by="")),
    ("spindle_speed_off", "bert", SpindleSpeedSwitch(off_by="bert")),
    ("spindle_speed", [SPEED | {"utc_s": 1.5e9}], DOCUMENTS[5]),
    ("spindle_speed", [], SpindleSpeeds(operations=())),
]
REFERENCE = {
    "reference_id": "000000000002",
    "utc_s": 1760008650.0,
    "source": "request 1 of the NC program (reference)",
    "degc": [24.36, None, 22.66],
    "program": 1000,
    "work_offset": 54,
    "power_on_count": 7,
}
REST = {
    "reference_id": "000000000002",
    "model_id": "increments-5cd2443d",
    "error_reference_id": "000000000002",
    "baseline_um": {"x": 0.0, "y": 1.2, "z": -5.194},
    "offset_um": {"x": 0.0, "y": 0.0, "z": -3.938},
    "weight": 0.788,
    "tools": {
        "2": {"baseline_um": [None, None, -9.212], "error_um": [0.0, 0.0, 0.167], "offset_um": [0.0, 0.0, -3.938]}
    },
}
SINCE = {
    "reference_id": "000000000002",
    "absent": [12],
    "excluded": {"11": "drift"},
    "of_model": {"model_id": "lagged-small", "reference_degc": {"2": [21.2, 21.6]}, "rest_after_min": 4.2},
    "labels": {
        "Room": {
            "sensor_ids": [11, 12],
            "reference_degc": [21.8, 21.3],
            "counted": [False, True],
            "offset_k": [0.005, None],
        }
    },
}
TOOL = {"number": 1, "begin_degc": {"A": 0.097, "Room": 0.023}, "reference_id": "000000000002"}
SEEN = {"utc_s": 1760009670.0, "clock_s": 9770.0, "sequence_number": 200, "idle": False}
OF_REFERENCE = {
    "reference": REFERENCE | {"request_counter": 5, "by_handshake": True},
    "kept_reference": REFERENCE,
    "rest": REST,
    "since_reference": SINCE,
    "tool": TOOL,
    "cnc_seen": SEEN,
}
"""What 0.1.0 kept of one reference, under six keys."""
KINDS = {key: kind for kind, key in KEYS.items()}


@pytest.fixture
def history(tmp_path):
    configuration = machine(tmp_path)
    layout = MachineLayout.from_configuration(configuration)
    return HistoryWriter(configuration.history.path, clock=HandClock(), machine=layout)


@pytest.fixture
def store(history):
    return StateStore(history, HandClock())


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: type(document).__name__)
def test_a_document_comes_back_as_it_was_put(history, store, document):
    store.put(document)
    kept = history.get_state(KEYS[type(document)])
    assert kept["format_version"] == FORMAT_VERSION
    assert store.get(type(document)) == document


@pytest.mark.parametrize(("key", "written", "document"), WRITTEN_BY_0_1_0)
def test_what_the_version_before_wrote_is_brought_to_the_form_of_now(history, store, key, written, document):
    history.put_state(key, written)
    assert store.get(KINDS[key]) == document


@pytest.mark.parametrize("damaged", [{"format_version": 99}, {"format_version": 2, "reasons": 7}, 7, [None], {"a": 1}])
def test_what_cannot_be_read_denies(history, store, damaged):
    for key in KINDS:
        history.put_state(key, damaged)
    fault, switch = store.get(OutputFault), store.get(SpindleSpeedSwitch)
    assert fault is not None and "cannot be read" in fault.reasons[0]
    assert switch is not None and switch.off_by
    if not isinstance(damaged, dict) or "a" not in damaged:
        assert store.get(WantedAxes) is None


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    time: Instant
    degc: FloatArray
    missing: float | None
    by_number: "MappingProxyType[int, tuple[float, ...]]"
    later: str = "a default"


def test_records_with_arrays_gaps_and_instants_survive(store):
    then = HandClock(900.0).now()
    sample = Sample(time=then, degc=np.array([1.0, np.nan]), missing=None, by_number=MappingProxyType({3: (1.0, 2.0)}))
    text = json.dumps(to_json(sample), allow_nan=False)
    content = json.loads(text)
    del content["later"]
    other_boot = Instant(monotonic_s=50.0, utc_s=then.utc_s + 40.0, real_s=50.0)
    taken = from_json(Sample, content, other_boot)
    assert np.array_equal(taken.degc, sample.degc, equal_nan=True)
    assert (dict(taken.by_number), taken.missing, taken.later) == ({3: (1.0, 2.0)}, None, "a default")
    assert taken.time == Instant(monotonic_s=10.0, utc_s=then.utc_s, real_s=10.0)


@pytest.mark.parametrize(
    ("kind", "value"),
    [(float, True), (int, 1.0), (bool, 1), (str, None), (tuple[float, ...], "12"), (DaemonAlive, {}), (FloatArray, 1)],
)
def test_a_value_of_another_type_is_refused(kind, value):
    with pytest.raises(DocumentError):
        from_json(kind, value, HandClock().now())
    assert math.isnan(from_json(float, None, HandClock().now()))


def reference_of_0_1_0(history, store, **changes):
    for key, value in (OF_REFERENCE | changes).items():
        history.put_state(key, value)
    return store.get(ReferenceDocument)


def test_six_keys_of_the_version_before_become_one_document(history, store):
    document = reference_of_0_1_0(history, store)
    record = document.record
    assert (document.state, document.request_counter) == (ReferenceState.VALID, 5)
    assert document.seen == CncSeen(utc_s=1760009670.0, clock_s=9770.0, sequence_number=200, idle=False)
    assert (record.reference_id, record.by_handshake, record.reference.program) == ("000000000002", True, 1000)
    assert record.reference.time.utc_s == 1760008650.0
    assert record.reference.time.monotonic_s == pytest.approx(1760008650.0 - HandClock().now().utc_s + 1000.0)
    assert np.array_equal(record.reference.degc, [24.36, np.nan, 22.66], equal_nan=True)
    baseline = record.baseline
    assert (baseline.axes, baseline.model_id, baseline.weight) == (("x", "y", "z"), "increments-5cd2443d", 0.788)
    assert baseline.baseline_um.tolist() == [0.0, 1.2, -5.194] and baseline.offset_um.tolist() == [0.0, 0.0, -3.938]
    assert np.array_equal(baseline.tools[2].baseline_um, [np.nan, np.nan, -9.212], equal_nan=True)
    assert record.tool == ToolOrigin(number=1, begin_degc={"A": 0.097, "Room": 0.023})
    assert record.sensors.absent == (12,) and record.sensors.excluded == {11: "drift"}
    assert record.sensors.of_model == SINCE["of_model"]
    assert record.sensors.labels["Room"].offset_k == (0.005, None)
    store.put(document)
    again = store.get(ReferenceDocument)
    assert again.record.sensors == record.sensors and again.seen == document.seen


def test_a_reference_that_had_ended_is_kept_for_the_tools(history, store):
    document = reference_of_0_1_0(history, store, reference=None, rest=REST | {"reference_id": None})
    assert document.state is ReferenceState.ENDED and not document.record.by_handshake
    assert list(document.record.baseline.tools) == [2]


def test_a_flipped_bit_in_a_kept_number_is_no_reference(history, store):
    document = reference_of_0_1_0(history, store)
    store.put(document)
    kept = history.get_state(KEYS[ReferenceDocument])
    kept["record"]["reference"]["degc"][0] = 24.32  # one bit of 24.36's text
    history.put_state(KEYS[ReferenceDocument], kept)
    assert store.get(ReferenceDocument) is None
    fault = json.loads(json.dumps(document_json(OutputFault(reasons=("a",)))).replace('"a"', '"c"'))
    history.put_state(KEYS[OutputFault], fault)
    assert "checksum" in store.get(OutputFault).reasons[0]


def test_without_the_levels_of_sensors_no_reference_counts(history, store):
    store.put(reference_of_0_1_0(history, store))
    store.put(SensorLevelsDocument(sensor_ids=(4,), shift_k={4: 0.25}, uncertainty_k={}, left=(), changes=()))
    assert store.get(ReferenceDocument).record is not None
    kept = history.get_state(KEYS[SensorLevelsDocument])
    kept["shift_k"] = {"4": 0.5}
    history.put_state(KEYS[SensorLevelsDocument], kept)
    left = store.get(ReferenceDocument)
    assert (left.state, left.record) == (ReferenceState.NONE, None)
    assert "levels" in left.ended and "checksum" in left.ended
    memory = LevelMemory(history, {4: "one"}, HandClock())
    ((from_s, _, sensors),) = memory.restored().gaps
    assert from_s <= -EPOCH_S and sensors == (0,), "nor does anything that the history holds of them"


def test_a_sensor_that_reads_something_else_has_no_past_however_often_others_stand_and_whatever_the_clock(
    history, store
):
    clock = HandClock()
    clock.calendar_s = 0.0  # a computer without a battery begins in 1970
    before = LevelMemory(history, {4: "one", 5: "five"}, clock)
    before.keep(before.restored(), {}, before.units)
    memory = LevelMemory(history, {4: "another", 5: "five"}, clock)
    levels = memory.restored()
    for at_s in range(2 * GAPS_KEPT):
        levels = with_gap(levels, float(at_s), at_s + 0.5, np.array([1]))
    clock.calendar_s = EPOCH_S  # the computer is told the time
    memory.keep(levels, {}, memory.units)
    kept = LevelMemory(history, {4: "another", 5: "five"}, clock).restored()
    assert np.isnan(unshifted(kept, -1e9, np.array([20.0, 21.0]))).tolist() == [True, False]
    assert len(kept.gaps) == GAPS_KEPT + 1


def test_a_document_without_a_checksum_is_one_of_a_version_before(history, store):
    kept = document_json(WantedAxes(axes={"z": True}))
    del kept["crc32"]
    history.put_state(KEYS[WantedAxes], kept)
    assert store.get(WantedAxes) == WantedAxes(axes={"z": True})
    kept = document_json(
        SensorLevelsDocument(sensor_ids=(4,), shift_k={4: 0.25}, uncertainty_k={}, left=(), changes=())
    )
    del kept["crc32"], kept["excluded"]
    history.put_state(KEYS[SensorLevelsDocument], kept)
    assert dict(store.get(SensorLevelsDocument).shift_k) == {4: 0.25}
    assert LevelMemory(history, {4: "one"}, HandClock()).excluded_before() == {}
