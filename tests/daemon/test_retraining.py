"""Proposals trained on the daemon's own history: measured minus applied, in a process of their own."""

import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from control_rig import SENSOR_IDS
from installation import Installation
from pyarrow import parquet
from rewired import EXCHANGED, rewired

from config.loader import load_configuration
from config.recordings.recording_map import RecordingMap, resolve_columns
from config.schema import Configuration
from config.schema.cnc_drivers import OpcUaNodesConfig
from config.schema.compensation import RetrainingConfig
from config.schema.displacements import DisplacementsConfig
from config.schema.service import HistoryConfig
from daemon.cli import main
from daemon.estimation.inputs import NoPositions
from daemon.estimation.rebuild import HistoryBackfill
from daemon.estimation.sensor_memory import LevelMemory
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.housekeeping.jobs import RetrainingJob
from daemon.model_release.exporting import Export, RecordingTable
from daemon.model_release.gate import reads_in_short
from daemon.model_release.past_recordings import commissioned_um_per_unit, recordings_from_history
from daemon.model_release.recording_files import _map_keys
from daemon.model_release.retraining import propose_from_history
from daemon.monitor.web.downloads import EXPORTER
from daemon.state_store.store import StateStore
from drivers.clock import SystemClock
from drivers.files.recording_csv import read_recording
from models.recordings.dataset import DatasetError, Recording
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.model import READS

CYCLE_MIN = 180
CYCLES = 5
MINUTES = CYCLES * CYCLE_MIN
ECHO_Y, ECHO_Z = 512, 513


def signals() -> dict[str, np.ndarray]:
    """Spindle on and off; five temperatures; two thermal errors; a compensation that wanders on its own."""
    rng = np.random.default_rng(1)
    rpm = np.tile(np.r_[np.full(100, 6000.0), np.zeros(80)], CYCLES)
    rpm *= np.repeat([1.0, 0.6, 0.8, 0.5, 0.9], CYCLE_MIN)
    quick, slow = lag_table(np.arange(float(MINUTES)), ((rpm / 6000.0) ** 2)[:, None], (8.0, 40.0))[:, :, 0]
    shares = np.array([[12.0, 0.0], [8.0, 3.0], [5.0, 5.0], [2.0, 9.0], [0.0, 10.0]])
    degc = 21.0 + np.column_stack([quick, slow]) @ shares.T + rng.normal(0.0, 0.02, (MINUTES, 5))
    error_um = np.column_stack([10.0 * quick, -30.0 * slow])
    applied_um = np.cumsum(rng.normal(0.0, 0.6, (MINUTES, 2)), axis=0)
    return {"rpm": rpm, "degc": degc, "error_um": error_um, "applied_um": applied_um}


def configured(
    installation: Installation, channels: tuple[str, str] = ("Y1", "Z1"), **retraining: object
) -> Configuration:
    content = yaml.safe_load(installation.config_path.read_text("utf-8"))
    content["displacements"] = {
        "file": {"path": "/srv/logger/*.csv", "header": "time"},
        "channels": [{"name": name, "column": name} for name in channels],
    }
    for axis, name in zip("yz", channels, strict=True):
        content["compensation"]["axes"][axis]["estimate"] = name
    content["compensation"]["retraining"] = {"model": "ridge", **retraining}
    installation.config_path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_configuration(installation.config_path)


def fill(configuration: Configuration, begin_s: float) -> None:
    layout = MachineLayout.from_configuration(configuration)
    writer = HistoryWriter(configuration.history.path, clock=SystemClock(), machine=layout)
    writer.start()
    made = signals()
    for number in range(MINUTES):
        at_s = begin_s + 60.0 * number
        for line, sensor_ids in layout.lines.items():
            columns = [SENSOR_IDS.index(sensor_id) for sensor_id in sensor_ids]
            writer.temperatures(None, make.cycle(line, number, at_s + 5.0, made["degc"][number, columns]))
        echo = dict(zip((ECHO_Y, ECHO_Z), (made["applied_um"][number] / 1000.0).tolist(), strict=True))
        writer.cnc_sample(make.cnc_sample(at_s + 10.0, spindle_speed_rpm=made["rpm"][number], macros=echo))
        um = made["error_um"][number] + made["applied_um"][number]
        writer.displacement(make.displacement(at_s + 20.0, um, source=f"/srv/logger/a.csv:{number + 2}"))
    writer.close()


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Installation, Configuration, float]:
    installation = Installation(tmp_path_factory.mktemp("retraining") / "here")
    configuration = configured(installation)
    begin_s = (time.time() - 60.0 * (MINUTES + 30)) // 60.0 * 60.0
    fill(configuration, begin_s)
    return installation, configuration, begin_s


def test_training_data_are_measured_minus_applied(machine: tuple[Installation, Configuration, float]) -> None:
    _, configuration, begin_s = machine
    made = signals()
    with HistoryReader(configuration.history.path) as reader:
        (recording,) = recordings_from_history(
            configuration, reader, {"y": 1000.0, "z": 1000.0}, from_utc_s=begin_s - 1e5, to_utc_s=begin_s + 1e5
        )
        (untouched,) = recordings_from_history(
            configuration, reader, None, from_utc_s=begin_s - 1e5, to_utc_s=begin_s + 1e5
        )
    assert recording.displacement_names == ("Y1", "Z1")
    assert recording.rows == MINUTES
    assert recording.displacements_um == pytest.approx(made["error_um"], abs=0.01)
    assert np.abs(untouched.displacements_um - made["error_um"]).max() > 3.0, "the compensation was not small"
    assert recording.temperatures_degc == pytest.approx(made["degc"], abs=0.01)
    assert recording.speed_rpm == pytest.approx(made["rpm"])
    assert recording.temperature_names == tuple(f"T{sensor_id}" for sensor_id in SENSOR_IDS)


def test_what_was_applied_under_another_commissioning_is_not_counted_by_the_signs_of_now(
    machine: tuple[Installation, Configuration, float], tmp_path: Path
) -> None:
    """It was turned round, or its control replaced: by the sign of now the machine's own error would be wrong twice."""
    _, configuration, begin_s = machine
    store, made, clock = tmp_path / "history.sqlite", signals(), make.StillClock()
    shutil.copy(configuration.history.path, store)
    writer = HistoryWriter(store, clock=clock, machine=MachineLayout.from_configuration(configuration))
    writer.start()
    for number, applied_um in enumerate(made["applied_um"]):
        clock.utc_s = begin_s + 60.0 * number + 12.0
        write_id = writer.write_intent(None, ((500, 1.0),), "cycle")
        writer.write_outcome(write_id, make.receipt(clock.utc_s, ((500, 1.0),), applied_um=np.r_[0.0, applied_um]))
    writer.close()
    span = {"from_utc_s": begin_s - 1e5, "to_utc_s": begin_s + 1e5}
    with HistoryReader(store) as reader:
        (recording,) = recordings_from_history(configuration, reader, {"y": 1000.0, "z": 1000.0}, **span)
        assert recording.rows == MINUTES and recording.displacements_um == pytest.approx(made["error_um"], abs=0.01)
        for other in ({"y": -1000.0, "z": 1000.0}, {"y": 1000.0, "z": 500.0}):
            words = r"no 120 .*; \d{3} minutes are left out, in which what was applied was counted by other signs"
            with pytest.raises(DatasetError, match=words):
                recordings_from_history(configuration, reader, other, **span)


@pytest.mark.parametrize("of", ["sensors", "control", "gauge", "gauge away"])
def test_nothing_is_trained_on_of_before_the_configuration_reads_what_it_reads_now(
    machine: tuple[Installation, Configuration, float], tmp_path: Path, of: str
) -> None:
    """A start on an edited configuration leaves a gap from the beginning in what the levels of its sensors count as."""
    _, configuration, begin_s = machine
    store = tmp_path / "history.sqlite"
    shutil.copy(configuration.history.path, store)
    configuration = configuration.model_copy(update={"history": HistoryConfig(path=store)})
    other_spindle = configuration.cnc.opcua.model_copy(update={"nodes": OpcUaNodesConfig(spindle_speed="s=Speed.2")})
    cnc = configuration.cnc.model_copy(update={"opcua": other_spindle})
    edited = rewired(configuration, EXCHANGED) if of == "sensors" else configuration.model_copy(update={"cnc": cnc})
    edits = [edited]
    if of.startswith("gauge"):  # it was wired the wrong way round
        assert configuration.displacements is not None
        first, *others = configuration.displacements.channels
        channels = [first.model_copy(update={"scale_um": -first.scale_um}), *others]
        measured = DisplacementsConfig(file=configuration.displacements.file, channels=channels)
        edited = configuration.model_copy(update={"displacements": measured})
        without = DisplacementsConfig(file=configuration.displacements.file, channels=others)
        edits = [configuration.model_copy(update={"displacements": without})] * (of == "gauge away") + [edited]
    made = dict[str, Any]()
    for each in (configuration, *edits):
        started(each)
        made = made or propose_from_history(each, RetrainingConfig(model="ridge"))
    model = model_from_json(Path(made["path"]).read_text("utf-8"), made["path"])
    read = {f"sensor {i}": each for i, each in configuration.reads.items()}
    assert model.hyper_parameters[READS] == reads_in_short(model, read | configuration.other_reads)
    left_out = r".*; what is older than 20.* is left out"
    with HistoryReader(store) as reader:
        with pytest.raises(DatasetError, match="no 120 minutes in a row" + left_out):
            recordings_from_history(edited, reader, None, from_utc_s=begin_s - 1e5, to_utc_s=begin_s + 1e5)
        with pytest.raises(DatasetError, match="no displacements were measured" + left_out):
            RecordingTable(edited, reader, Export(what="recording", format="csv", from_s=begin_s, to_s=begin_s + 1e5))


def started(configuration: Configuration) -> None:
    """Leave in the store what a start of the daemon with this configuration leaves of the sensors' levels."""
    layout, clock = MachineLayout.from_configuration(configuration), SystemClock()
    history = HistoryWriter(configuration.history.path, clock=clock, machine=layout)
    memory = LevelMemory(history, configuration.reads, clock)
    memory.keep(memory.restored(), {}, memory.units)
    HistoryBackfill(configuration, clock, NoPositions(), StateStore(history, clock))
    history.start()
    history.close()


async def test_the_job_trains_in_a_process_of_its_own_when_it_is_due(
    machine: tuple[Installation, Configuration, float],
) -> None:
    installation, configuration, _ = machine
    said: list[tuple[str, str]] = []
    retraining = configuration.compensation.retraining
    assert retraining is not None
    assert retraining.every_hours == 8.0
    job = RetrainingJob(configuration, installation.config_path, retraining, lambda *words: said.append(words))
    assert job.due(time.time())
    await job.run_if_due()
    ((kind, text),) = said
    assert kind == "proposal"
    (path,) = (installation.folder / "state/proposals").glob("*.json")
    assert path.name in text
    assert "14.98 h of history" in text
    model = model_from_json(path.read_text("utf-8"), str(path))
    assert model.channels == ("Y1", "Z1")
    assert set(model.sensor_ids) <= set(SENSOR_IDS)
    assert max(model.band_um) < 8.0, "with the compensation left in, the band would be as wide as it wandered"
    assert not job.due(time.time())
    assert job.due(time.time() + 8 * 3600.0 + 60.0)
    fresh = RetrainingJob(configuration, installation.config_path, retraining, lambda *words: said.append(words))
    assert not fresh.due(time.time()), "a restart of the daemon changes nothing"
    await fresh.run_if_due()
    assert len(said) == 1


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_recording_that_is_downloaded_is_what_training_reads(
    machine: tuple[Installation, Configuration, float], tmp_path: Path, form: str
) -> None:
    _, configuration, begin_s = machine
    request = {
        "configuration": configuration.model_dump_json(),
        **{"what": "recording", "format": form, "from_s": begin_s, "to_s": begin_s + 60.0 * MINUTES},
    }
    done = subprocess.run(EXPORTER, input=json.dumps(request).encode(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    path = tmp_path / f"recording.{form}"
    path.write_bytes(done.stdout)
    with HistoryReader(configuration.history.path) as reader:
        um_per_unit = commissioned_um_per_unit(configuration)
        (expected,) = recordings_from_history(
            configuration, reader, um_per_unit, from_utc_s=begin_s, to_utc_s=begin_s + 60.0 * MINUTES
        )
    if form == "parquet":
        table = parquet.read_table(path)
        assert table.num_rows == expected.rows
        assert table["Z1_um"].to_numpy() == pytest.approx(expected.displacements_um[:, 1])
        return
    found = read_recording(path)
    assert found.rows == expected.rows
    assert found.displacement_names == expected.displacement_names, "what `estimate` of the axes names"
    assert found.displacements_um == pytest.approx(expected.displacements_um)
    assert found.temperatures_degc == pytest.approx(expected.temperatures_degc)
    assert found.speed_rpm == pytest.approx(expected.speed_rpm)
    trained = CliRunner().invoke(
        main, ["thermal", "train", str(path), "--model", "ridge", "--output", str(tmp_path / "model.json")]
    )
    assert trained.exit_code in (0, 1) and (tmp_path / "model.json").exists(), trained.output
    model = model_from_json((tmp_path / "model.json").read_text("utf-8"), "model.json")
    assert set(model.channels) <= {axis.estimate for axis in configuration.compensation.axes.values()}


def test_an_exported_recording_is_what_train_reads(
    machine: tuple[Installation, Configuration, float], tmp_path: Path
) -> None:
    installation, configuration, begin_s = machine
    exported = ["export", "-c", installation.config_path, "--what", "recording", "--from", "-48h"]
    run = tmp_path / "run.csv"
    result = CliRunner().invoke(main, [str(part) for part in [*exported, "-o", run]])
    assert result.exit_code == 0, result.output
    assert f"thermal train {run} --model default" in result.stderr
    with HistoryReader(configuration.history.path) as reader:
        (held,) = recordings_from_history(
            configuration,
            reader,
            commissioned_um_per_unit(configuration),
            from_utc_s=begin_s - 1e5,
            to_utc_s=begin_s + 1e5,
        )
    read = read_recording(run)
    assert (read.temperature_names, read.displacement_names) == (held.temperature_names, held.displacement_names)
    np.testing.assert_allclose(read.time_s, held.time_s)
    np.testing.assert_allclose(read.temperatures_degc, held.temperatures_degc, atol=1e-4)
    np.testing.assert_allclose(read.displacements_um, held.displacements_um, atol=1e-4)
    assert read.speed_rpm is not None and held.speed_rpm is not None
    np.testing.assert_allclose(read.speed_rpm, held.speed_rpm, atol=0.1)
    command = ["thermal", "train", str(run), "--model", "ridge", "-o", str(tmp_path / "model.json")]
    assert CliRunner().invoke(main, command).exit_code == 0


@pytest.mark.parametrize("channel", ["dz (mm)", "dz (in)"])
def test_a_channel_that_is_called_after_another_unit_is_exported_in_micrometres(channel: str) -> None:
    held = Recording(
        name="run",
        time_s=np.zeros(1),
        speed_rpm=None,
        temperature_names=("T1",),
        temperatures_degc=np.zeros((1, 1)),
        displacement_names=(channel,),
        displacements_um=np.zeros((1, 1)),
    )
    keys = RecordingMap.model_validate(_map_keys(held, {}))
    assert resolve_columns(keys, [keys.time, "T1", channel]).displacement_units == ["um"], "train refused its own file"


@pytest.mark.parametrize(
    ("output", "begin", "sentence"),
    [
        ("run.parquet", "-100d", "a recording is a CSV file"),
        ("run.csv", "2001-01-01", "has no 120 minutes in a row with displacements of Y1, Z1, 0 at most; leave the"),
    ],
)
def test_a_recording_that_cannot_be_exported_is_refused(
    machine: tuple[Installation, Configuration, float], tmp_path: Path, output: str, begin: str, sentence: str
) -> None:
    end = ["--to", "2001-01-02"] if begin.startswith("2001") else []
    where = ["-c", str(machine[0].config_path), "-o", str(tmp_path / output)]
    result = CliRunner().invoke(main, ["export", "--what", "recording", "--from", begin, *end, *where])
    assert result.exit_code == 2 and sentence in result.stderr
    assert not list(tmp_path.iterdir())
