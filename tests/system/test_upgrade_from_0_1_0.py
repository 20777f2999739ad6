"""Everything that version 0.1.0 left on a disk is taken over; `fixtures/version_0_1_0` holds files that it wrote."""

import json
import math
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from control_rig import EPOCH_S, SENSOR_IDS, HandClock, Rig, running
from memory_cnc import MemoryNc
from whole_loop import WholeLoop

from config.loader import load_configuration
from config.records.commissioning import commissioning_inhibit, load_commissioning, macro_map_digest
from config.schema import Configuration
from config.yaml_document import RENAMED
from daemon.cli import main
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.estimation.model_in_use import ModelInUse
from daemon.history.database import connect_writer
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.restart_reader import TABLES
from daemon.history.writer import HistoryWriter
from daemon.model_release.bearings import load_released_bearings
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released, read_model
from drivers.opcua.cnc import node_map
from models.control.state import OperatorRequest
from models.records import Instant, Reference
from models.thermal.estimation import Machine
from models.thermal.family import model_from_json as thermal_model_from_json

OLD = Path(__file__).parents[1] / "fixtures/version_0_1_0"
EVER = (0.0, 1e11)
PLACES = {"/var/lib/toolpoint-models": "models", "/var/lib/toolpoint": "state", "/etc/toolpoint": "etc"}
"""Folders of the old installation, and where they lie here."""
STORES = ("store", "store_fault")


def expected(name: str) -> Any:
    return json.loads((OLD / name).read_text(encoding="utf-8"))


def plain(value: Any) -> Any:
    """Return numbers and records as the JSON of the fixtures: NaN is null, keys are text."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each) for each in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int | bool) else str(value)


def agree(found: Any, wanted: Any, where: str = "") -> None:
    """Check that everything the old version saw is there with the same values; there may be more."""
    if isinstance(wanted, dict):
        for key, value in wanted.items():
            assert key in found, f"{where}: no {key}"
            agree(found[key], value, f"{where}.{key}")
    elif isinstance(wanted, list):
        assert len(found) == len(wanted), where
        for place, (one, other) in enumerate(zip(found, wanted, strict=True)):
            agree(one, other, f"{where}[{place}]")
    elif isinstance(wanted, float):
        assert found == pytest.approx(wanted, rel=1e-9, abs=1e-9), where
    else:
        assert found == wanted, where


@dataclass(frozen=True)
class Installed:
    """The old installation, copied to a folder of the test."""

    folder: Path

    @property
    def configuration(self) -> Configuration:
        return load_configuration(self.folder / "etc/toolpoint.yaml")

    def run(self, *words: str) -> Any:
        """Run a command on it; return its JSON."""
        path = self.folder / "answer.json"
        path.unlink(missing_ok=True)
        found = CliRunner().invoke(
            main, [*words, "--config", str(self.folder / "etc/toolpoint.yaml"), "--json", str(path)]
        )
        assert found.exit_code == 0, found.output
        return json.loads(path.read_text(encoding="utf-8"))


def moved(text: str, folder: Path) -> str:
    """Return a text with the paths of the old installation as they are here."""
    for place, name in PLACES.items():
        text = text.replace(place + "/", f"{folder}/{name}/")
    return text


def install(folder: Path, store: str = "store") -> Installed:
    shutil.copytree(OLD / "config", folder / "etc")
    shutil.copytree(OLD / store, folder / "state")
    shutil.copytree(OLD / "shelf", folder / "models", symlinks=True)
    shutil.copytree(OLD / "proposals", folder / "state/proposals")
    shutil.copyfile(OLD / "commissioning/record.json", folder / "etc/commissioning.json")
    for path in (folder / "etc").glob("*.yaml"):
        path.write_text(moved(path.read_text(encoding="utf-8"), folder), encoding="utf-8")
    return Installed(folder)


@pytest.fixture
def installed(tmp_path: Path) -> Installed:
    return install(tmp_path)


# --- configuration ---------------------------------------------------------------------------


UNUSED_DEFAULT_S = 5.0
"""0.1.0 had this for `reference.max_gap_s`, which is used no longer [s]."""


def with_present_names(content: dict[str, Any]) -> dict[str, Any]:
    """Return an old configuration's content under the names that its keys have now; the default of one is gone."""
    if content["compensation"]["reference"]["max_gap_s"] == UNUSED_DEFAULT_S:
        del content["compensation"]["reference"]["max_gap_s"]
    for old, new in RENAMED.items():
        *sections, key = old.split(".")
        part: Any = content
        for section in sections:
            part = part.get(section) or {}
        if key in part:
            value = part.pop(key)
            *sections, key = new.split(".")
            part = content
            for section in sections:
                part = part.setdefault(section, {})
            part[key] = value
    return content


@pytest.mark.parametrize("name", ["toolpoint.yaml", "toolpoint_minimal.yaml", "toolpoint_alternatives.yaml"])
def test_configurations_say_what_they_said(name: str) -> None:
    wanted = expected("config_expected.json")[name]
    configuration = load_configuration(OLD / "config" / name)
    found = json.loads(configuration.model_dump_json().replace(f"{OLD}/config/", "/etc/toolpoint/"))
    # What a key of `nodes` is where none is given is the preset's now, and the driver's to know.
    if configuration.cnc is not None and configuration.cnc.opcua is not None:
        found["cnc"]["opcua"]["nodes"] = dict(node_map(configuration.cnc).nodes)
    agree(spindle_names(found), with_present_names(spindle_names(wanted)), name)


def spindle_names(content: Any) -> Any:
    """Return a mapping without the folder in which the program keeps its spindle files."""
    if isinstance(content, dict):
        content = {key: spindle_names(value) for key, value in content.items()}
        if "spindles" in content:
            content["spindles"] = {axis: Path(path).name for axis, path in content["spindles"].items()}
    return [spindle_names(each) for each in content] if isinstance(content, list) else content


# --- commissioning ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "inhibit"), [("record", ""), ("record_format_1", "is of format 1")])
def test_commissioning_records_still_match(name: str, inhibit: str) -> None:
    cnc = load_configuration(OLD / "config/toolpoint.yaml").cnc
    record = load_commissioning(OLD / f"commissioning/{name}.json")
    assert record.macro_map_sha256 == macro_map_digest(cnc.macros), "every machine would have to be commissioned anew"
    assert plain(record.model_dump(exclude_unset=True)) == expected(f"commissioning/{name}.json")
    to_take_back, to_enable = (
        commissioning_inhibit(record, cnc_identity=record.cnc_identity, macros=cnc.macros, axes=axes, guard_version=1.0)
        for axes in ((), tuple(record.axes))
    )
    assert to_take_back == inhibit if not inhibit else inhibit in to_take_back
    assert "cnc.macros.check names no variable" in to_enable, "0.1.0 had no check"


# --- store -----------------------------------------------------------------------------------


@pytest.fixture(params=STORES)
def store(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    """A store that a writer of this version has opened, as the daemon does at its start."""
    installed = install(tmp_path, request.param)
    path = installed.configuration.history.path
    writer = HistoryWriter(path, clock=HandClock(), machine=MachineLayout.from_configuration(installed.configuration))
    writer.start()
    writer.close()
    return request.param, path


def test_stores_are_migrated_and_read_the_same(store: tuple[str, Path]) -> None:
    name, path = store
    wanted = expected(f"{name}/expected.json")
    with HistoryReader(path) as reader:
        for what in ("row_count", "extent"):
            agree(plain({kind: getattr(reader, what)(kind) for kind in TABLES}), wanted[what], what)
        for what in (
            "sensor_ids",
            "acknowledged",
            "last_displacement_utc_s",
            "last_written_macros",
            "unsettled_writes",
        ):
            agree(plain(getattr(reader, what)()), wanted[what], what)
        for what in ("events", "probes", "references"):
            agree(plain(getattr(reader, what)(*EVER)), wanted[what], what)
        writes = reader.writes(*EVER)
        assert len(writes) == wanted["writes"]["count"]
        agree(plain([writes[0], writes[-1]]), [wanted["writes"]["first"], wanted["writes"]["last"]], "writes")
        for outcome in ("DIFFERS", "FAILED", "REFUSED"):
            agree(plain([each for each in writes if each.outcome.name == outcome]), wanted["writes"][outcome], outcome)
        for what in ("cnc", "displacements", "estimates"):
            series = plain(asdict(getattr(reader, what)(*EVER)))
            assert len(series["time_s"]) == wanted[what]["count"]
            for row, values in wanted[what]["rows"].items():
                agree(at(series, int(row)), values, f"{what} {row}")
        check_temperatures(reader, wanted["temperatures"])
    for what, file in (("last_block", WriteAheadRecord.beside(path)), ("last_speed", WriteAheadRecord.of_speed(path))):
        agree(plain(file.load()), wanted[what], what)


def at(series: Any, row: int) -> Any:
    """Return one row of columns."""
    return {key: at(value, row) for key, value in series.items()} if isinstance(series, dict) else series[row]


def check_temperatures(reader: HistoryReader, wanted: dict[str, Any]) -> None:
    whole = reader.temperatures(None, *EVER)
    assert len(whole.time_s) == wanted["cycles"]
    agree(plain(np.nansum(whole.degc, axis=0)), wanted["sum_degc"], "sum_degc")
    codes, counts = np.unique(whole.quality, return_counts=True)
    assert dict(zip(map(str, codes), counts, strict=True)) == wanted["quality_counts"]
    for stretch in ("packed", "last"):
        if stretch in wanted:
            part = dict(wanted[stretch])
            found = reader.temperatures(None, part.pop("from_utc_s"), part.pop("to_utc_s"))
            agree(plain(asdict(found)), part, stretch)


def test_the_commands_show_the_old_store(installed: Installed) -> None:
    wanted = expected("store/expected.json")
    connect_writer(installed.configuration.history.path).close()  # as the first start does: it migrates the store
    summary = installed.run("history")
    shown = {kind: each["rows"] for kind, each in summary["kinds"].items()}
    assert {kind: shown[kind] for kind in wanted["row_count"]} == wanted["row_count"]
    assert len(installed.run("history", "events", "--last", "36500d")) == len(wanted["events"])


# --- restart ---------------------------------------------------------------------------------


class Restarted(WholeLoop):
    """A daemon of this version on the store and the control that the old one left."""

    def __init__(self, installed: Installed, model: Any) -> None:
        there = expected("store/control.json")
        self.configuration, self.model = installed.configuration, model
        self.clock = HandClock(there["clock"]["monotonic_s"] + 20.0)
        self.nc = MemoryNc(self.configuration, self.clock)
        for number, value in there["macros"].items():
            self.nc.macros.set(int(number), value)
        self.nc.macros.set(549, 24.5625)
        self.nc.guard.applied_um.update(there["guard_applied_um"])
        self.nc.sequence_number = there["sequence_number"]
        self.record = load_commissioning(installed.folder / "etc/commissioning.json")
        self.degc = np.array([24.5625, 24.5, 24.9, 22.5, 21.75])
        self.rise_k = np.zeros(len(SENSOR_IDS))
        self.offset_k = np.array([0.0, 0.0, 0.0, np.nan, 0.0])
        self._numbers = dict.fromkeys(("spindle", "column"), 0)

    def new_rig(self) -> Rig:
        return Rig(self.configuration, self.nc, self.clock, record=self.record, model_id=self.model.model_id)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Every key of the state that is read."""
    keys: set[str] = set()
    get_state = HistoryWriter.get_state

    def listed(history: HistoryWriter, key: str) -> Any:
        keys.add(key)
        return get_state(history, key)

    monkeypatch.setattr(HistoryWriter, "get_state", listed)
    return keys


@pytest.fixture
async def restarted(asked: set[str], installed: Installed) -> Any:
    model = load_released(installed.configuration, own_account()).model
    assert model is not None
    loop = Restarted(installed, model)
    await loop.start()
    yield loop
    await loop.end()


async def test_a_restart_goes_on_where_the_old_version_was_killed(restarted: Restarted) -> None:
    wanted, control = expected("store/restarted.json"), restarted.rig.control
    resume = expected("store/resumed.json")["resume_point"]
    possible = {str(number): set(values) for number, values in (restarted.rig.resume.known_macros or {}).items()}
    for number, values in resume["known_macros"].items():
        assert possible[number] == set(values), number
    await restarted.moment()
    memory, then = plain(control.memory), wanted["memory_at_first"]
    for what in (
        "state",
        "command_um",
        "baseline_um",
        "reference_id",
        "model_id",
        "offset_um",
        "wanted",
        "weight",
        "tools",
    ):
        agree(memory[what], then[what], what)
    assert control.journal.fault is None
    agree(plain(control.reference), wanted["reference"], "reference")
    await restarted.rig.history.flushed()
    with HistoryReader(restarted.configuration.history.path) as reader:
        (settled,) = (each for each in reader.writes(*EVER) if each.write_id == wanted["writes_settled"]["write_id"])
    for what in ("outcome", "read_back", "applied_um", "requested_um"):
        agree(plain(getattr(settled, what)), wanted["writes_settled"][what], what)
    for _ in range(3):
        await restarted.moment()
    assert control.memory is not None and control.memory.state.value == "HOLD"
    assert "cnc.macros.check names no variable" in control.memory.reason, "0.1.0 had no check, so nothing is followed"
    agree(plain(control.memory.offset_um), wanted["memory_after_30_moments"]["offset_um"], "offset_um")


async def test_every_state_that_was_kept_is_read(restarted: Restarted, asked: set[str]) -> None:
    await restarted.moment()
    assert asked >= set(expected("store/expected.json")["state"])
    record = restarted.rig.control._references.memory.record
    assert record is not None and record.tool is not None and record.sensors is not None
    agree(plain(record.reference), expected("store/resumed.json")["resume_point"]["kept_reference"], "kept_reference")
    assert record.sensors.absent == (11,) and set(record.sensors.labels) == {"A", "Room"}
    assert set(record.tool.begin_degc) == {"A", "Room"}


async def test_what_the_old_version_applied_is_taken_back(restarted: Restarted) -> None:
    control = restarted.rig.control
    restarted.nc.guard.place(restarted.nc.macros, expected("store/control.json")["guard_applied_um"])
    await restarted.moment()
    assert control.request(OperatorRequest(zero=True), "p") == ""
    for _ in range(80):
        await restarted.moment()
        restarted.nc.safe_point()
    assert control.memory is not None and control.memory.state.value == "OFF", control.memory
    assert control.journal.fault is None
    assert all(abs(um) < 0.1 for um in restarted.nc.guard.applied_um.values())


async def test_a_latched_fault_and_a_switch_survive(tmp_path: Path) -> None:
    installed, wanted = install(tmp_path, "store_fault"), expected("store_fault/expected.json")
    clock = HandClock(wanted["state"]["alive_utc_s"] - EPOCH_S + 30.0)
    record = load_commissioning(installed.folder / "etc/commissioning.json")
    nc = MemoryNc(installed.configuration, clock)
    for number, values in wanted["last_block"].items():
        nc.macros.set(int(number), values[-1])
    rig = Rig(installed.configuration, nc, clock, record=record)
    async with running(rig):
        await rig.turn()
        assert rig.state == "FAULT" and rig.control.journal.fault == wanted["state"]["fault"]
        snapshot = rig.speed.snapshot()
        assert snapshot is not None and snapshot.switched_on is False


# --- models ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def series() -> dict[str, Any]:
    content = expected("models/input.json")
    numbers = {name: np.array(content[name], dtype=float) for name in ("time_s", "rpm", "degc")}
    return content | numbers


@pytest.mark.parametrize("rewritten", [False, True])
@pytest.mark.parametrize("name", sorted(path.stem for path in (OLD / "models").glob("*_*.json")))
def test_model_files_give_the_same_estimates(name: str, rewritten: bool, series: dict[str, Any]) -> None:
    wanted = expected("models/expected.json")[name]
    model, refused = read_model(OLD / f"models/{name}.json", SENSOR_IDS, wanted["channels"])
    if wanted.get("refused"):
        assert model is None and "needs axis positions (Z_mm)" in refused
        return
    assert model is not None, refused
    if rewritten:
        model = thermal_model_from_json(model.to_json(), name)
    for what in ("model_id", "kind", "channels", "sensor_ids", "band_um"):
        agree(plain(getattr(model, what)), wanted[what], what)
    time_s, degc, rpm, begin = series["time_s"], series["degc"], series["rpm"], series["reference_row"]

    def past(from_s: float, to_s: float, _: float) -> Iterator[tuple[float, Any, float]]:
        for moment_s, values, speed_rpm in zip(time_s, degc, rpm, strict=True):
            if from_s < moment_s <= to_s:
                yield float(moment_s), values, float(speed_rpm)

    machine = Machine(components=dict(zip(SENSOR_IDS, series["components"], strict=True)))
    followed = ModelInUse(model, SENSOR_IDS, machine, past)
    reference_s = float(time_s[begin])
    followed.prepare(reference_s, {})
    followed.on_sample(reference_s, degc[begin], float(rpm[begin]))
    reference = Reference(
        reference_id="r1",
        time=Instant(monotonic_s=reference_s, utc_s=EPOCH_S + reference_s, real_s=reference_s),
        source="O1000 N100",
        degc=degc[begin].copy(),
        program=1000,
        work_offset=54,
        power_on_count=7,
    )
    followed.set_reference(reference, reference_s)
    absent, rows = np.zeros(len(SENSOR_IDS), dtype=bool), {each["row"]: each for each in wanted["estimates"]}
    missing = np.flatnonzero(np.isnan(degc[begin:]).any(axis=1)) + begin
    returned = int(missing[-1]) + 1
    assert sum(row < returned for row in rows) >= 6, "0.1.0 re-based a sensor that returned; it counts again now"
    for row in range(begin + 1, len(time_s)):
        followed.on_sample(float(time_s[row]), degc[row], float(rpm[row]))
        found, reference = followed.estimate(reference, float(time_s[row]), degc[row], absent)
        away = absent.copy()
        away[followed.places] = False
        absent = away | ~np.isfinite(degc[row])
        if row in rows and row < returned:
            # Confidence is judged anew: by the share of a change that training knows, and not by its size.
            names = [key for key in rows[row] if key not in ("row", "confidence")]
            seen = {key: getattr(found, key) for key in names}
            # Each channel has one now, and it says by how much what is imputed may be off, too.
            factor, before = float(np.max(seen.pop("band_factor"))), rows[row]["band_factor"]
            assert factor >= before - 1e-9 if found.imputed else factor == pytest.approx(before, rel=1e-9), f"row {row}"
            agree(plain(seen), {k: rows[row][k] for k in seen}, f"row {row}")


# --- releases and back-ups -------------------------------------------------------------------


@pytest.mark.parametrize(("options", "record"), [((), "releases"), (("--bearings",), "bearings-releases")])
def test_the_shelf_of_releases_is_read(installed: Installed, options: tuple[str, ...], record: str) -> None:
    load = load_released_bearings if options else load_released
    found = load(installed.configuration, own_account())
    assert found.model is not None and found.record is not None, found.inhibit
    agree(plain(found.record.model_dump()), expected(f"shelf/{record}/0003/release.json"), record)
    listed = installed.run("model", "list", *options)
    assert [each["number"] for each in listed["releases"]] == [1, 2, 3], listed
    back = installed.run("model", "rollback", "--to", "2", *options)
    assert back["model_id"] == expected(f"shelf/{record}/0002/release.json")["model_id"]


def test_the_backup_restores(tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    shutil.copyfile(next((OLD / "backup").glob("*.tar")), archive)
    installed = install(tmp_path / "machine")
    verified = installed.run("restore", str(archive), "--verify")
    agree(verified, expected("backup/expected.json"), "manifest")
    refused = CliRunner().invoke(
        main, ["restore", str(archive), "--replace", "--config", str(installed.folder / "etc/toolpoint.yaml")]
    )
    assert refused.exit_code == 1 and "--store /var/lib/toolpoint/history.sqlite" in refused.output
    done = installed.run("restore", str(archive), "--replace", "--keep-configuration")
    assert all(Path(path).is_relative_to(installed.folder) for path in done["placed"])
    wanted, path = expected("backup/restored.json"), installed.configuration.history.path
    with closing(sqlite3.connect(path)) as connection:
        states = {key: json.loads(text) for key, text in connection.execute("SELECT key, json FROM state")}
        outcomes = [list(row) for row in connection.execute("SELECT outcome, count(*) FROM writes GROUP BY outcome")]
    assert states["fault"]["reasons"] == [wanted["state"]["fault"]] and not {"wanted", "reference"} & set(states)
    assert outcomes == wanted["writes_by_outcome"]
    for place in wanted["placed"]:
        assert Path(moved(place, installed.folder)).exists()
