"""From a foreign CSV to a model: proposed maps, columns that differ, sensors that contradict the others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from thermal_runs import run

from config.recordings import recording_map
from config.recordings.recording_map import RecordingMap, load_recording_map
from daemon.cli import main
from drivers.files.recording_csv import read_recording, write_recording
from drivers.files.recording_lines import read_header
from models.thermal.family import ThermalModel, model_from_json

NAMES = ("Temp Spindel [°C]", "Temp Bett (°C)", "Temp Raum [°C]", "Temp Motor [°C]")

MAP = (
    "time: Uhrzeit\ndate: Datum\ntime_format: '%d.%m.%Y %H:%M:%S'\nspeed: Drehzahl [1/min]\n"
    "temperatures: ['Temp*']\ndisplacements: ['Weg*']\n"
)


def foreign(path: Path, seed: int, *, without: str = "", stuck: int | None = None, encoding: str = "utf-8") -> Path:
    """A run of five hours at two speeds, as a German logger writes it."""
    rng = np.random.default_rng(seed)
    minutes = np.arange(300)
    rpm = np.where(minutes // 60 % 2 == 0, rng.choice([3000.0, 5000.0, 8000.0]), 0.0)
    quick, slow = np.zeros(300), np.zeros(300)
    for row in range(1, 300):
        quick[row] = quick[row - 1] + ((rpm[row] / 500.0) - quick[row - 1]) / 12.0
        slow[row] = slow[row - 1] + ((rpm[row] / 500.0) - slow[row - 1]) / 80.0
    degc = 21.0 + np.column_stack([quick, slow, 0.1 * slow + rng.normal(0.0, 0.3), 0.5 * quick + 0.5 * slow])
    degc += rng.normal(0.0, 0.03, degc.shape)
    if stuck is not None:
        degc[100:, stuck] = degc[100, stuck]
    um = 2.0 * slow + 0.5 * quick + rng.normal(0.0, 0.05, 300)
    columns: dict[str, Any] = {"Drehzahl [1/min]": rpm, **dict(zip(NAMES, degc.T, strict=True)), "Weg Z [µm]": um}
    columns.pop(without, None)
    lines = [";".join(["Datum", "Uhrzeit", *columns])]
    for row, minute in enumerate(minutes):
        clock = f"{7 + minute // 60:02}:{minute % 60:02}:00"
        lines.append(";".join(["05.02.2026", clock, *(f"{v[row]:.2f}".replace(".", ",") for v in columns.values())]))
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def thermal(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["thermal", *map(str, arguments)])


def model(path: Path) -> ThermalModel:
    return model_from_json(path.read_bytes(), str(path))


def runs(folder: Path, **changes: Any) -> list[Path]:
    return [foreign(folder / f"tag{number}.csv", number, **(changes if number == 2 else {})) for number in range(4)]


def test_without_a_map_one_is_printed_to_paste(tmp_path: Path) -> None:
    result = thermal("train", *runs(tmp_path), "-o", tmp_path / "model.json")
    assert result.exit_code == 2 and not (tmp_path / "model.json").exists()
    assert "or take it as it is with --map-out" in result.stderr
    (pasted := tmp_path / "map.yaml").write_text(result.stdout, encoding="utf-8")
    assert load_recording_map(pasted).temperatures == list(NAMES)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_with_map_out_a_foreign_csv_becomes_a_model_in_one_go(tmp_path: Path, encoding: str) -> None:
    files = [foreign(tmp_path / f"tag{number}.csv", number, encoding=encoding) for number in range(4)]
    result = thermal(
        "train", *files, "--model", "ridge", "--map-out", tmp_path / "map.yaml", "-o", tmp_path / "model.json"
    )
    assert result.exit_code == 0, result.output
    assert "check it" in result.stderr
    numbered = ", ".join(f"{number} is {name!r}" for number, name in enumerate(NAMES, start=1))
    assert f"the machine's configuration must give these sensors the same IDs: {numbered}\n" in result.stderr
    made = model(tmp_path / "model.json")
    assert (made.channels, made.sensor_names) == (("Weg Z [µm]",), NAMES)
    evaluated = thermal(
        "evaluate", *files, "--map", tmp_path / "map.yaml", "--leave-out-runs", "--model", "ridge", "--json", "-"
    )
    assert json.loads(evaluated.stdout)["mean"]["reduction_rmse"] > 0.8


def test_files_of_one_name_in_several_folders_are_told_apart(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"day{number}").mkdir()
    files = [foreign(tmp_path / f"day{number}" / "log.csv", number) for number in range(4)]
    (columns := tmp_path / "map.yaml").write_text(MAP, encoding="utf-8")
    options = ("--map", columns, "--model", "ridge", "--json", "-")
    found = json.loads(thermal("evaluate", *files, "--leave-out-runs", *options).stdout)
    names = [f"day{number}/log.csv" for number in range(4)]
    assert [test["name"] for test in found["tests"]] == names == list(found["hyper_parameters"])
    trained = thermal("train", *files, "--without", "day2/log.csv", "-o", tmp_path / "model.json", *options)
    assert json.loads(trained.stdout)["recordings_left_out"] == ["day2/log.csv"], "it left out all of them"


@pytest.mark.parametrize("clock", ["2026-02-05T07:{:02}:00", "07:{:02}:00"])
def test_a_time_of_a_usual_name_that_is_no_number_makes_a_map(tmp_path: Path, clock: str) -> None:
    rows = [f"{clock.format(minute)},{20 + minute},{minute}" for minute in range(9)]
    (path := tmp_path / "day.csv").write_text("\n".join(["time,T1,Z1_um", *rows]) + "\n", encoding="utf-8")
    proposed = thermal("train", path, "-o", tmp_path / "model.json")
    assert "time: time" in proposed.stdout and "or take it as it is with --map-out" in proposed.stderr
    (half := tmp_path / "half.csv").write_text("time_s,dz [um]\n0,1\n", encoding="utf-8")
    lacking = thermal("train", half, "-o", tmp_path / "m.json").stderr
    assert "none seems to be its temperatures; where another file holds these, join the two by time first" in lacking
    (bare := tmp_path / "bare.csv").write_text("time,T1,Z1_um\n", encoding="utf-8")
    assert thermal("train", bare, "-o", tmp_path / "m.json").stderr == f"{bare}: holds no rows after its header\n"
    refused = thermal("evaluate", path, "--leave-out-cycles")
    assert "is not a time in s; where it is a date or a time of day, say" in refused.stderr


def test_columns_that_differ_are_named_and_the_common_ones_offered(tmp_path: Path) -> None:
    files = runs(tmp_path, without=NAMES[2])
    (good := tmp_path / "map.yaml").write_text(MAP, encoding="utf-8")
    for command in (["train", "-o", tmp_path / "model.json"], ["evaluate", "--leave-out-runs"]):
        refused = thermal(command[0], *files, "--map", good, *command[1:])
        assert refused.exit_code == 2
        assert f"tag2.csv lacks {NAMES[2]}. Record all" in refused.stderr
        assert f'temperatures: ["{NAMES[0]}", "{NAMES[1]}", "{NAMES[3]}"]' in refused.stderr
    renamed = runs(tmp_path)
    text = renamed[2].read_text(encoding="utf-8").replace(NAMES[2], "Raum neu")
    renamed[2].write_text(text, encoding="utf-8")
    refused = thermal("train", *renamed, "--map", good, "-o", tmp_path / "model.json")
    assert f"tag2.csv lacks {NAMES[2]} and alone has Raum neu (the same under another name?)" in refused.stderr
    files = runs(tmp_path, without=NAMES[2])
    result = thermal(
        "train", *files, "--map", good, "--model", "ridge", "--common-columns", "-o", tmp_path / "model.json"
    )
    assert result.exit_code == 0, result.output
    assert model(tmp_path / "model.json").sensor_names == (NAMES[0], NAMES[1], NAMES[3])
    assert f"left out, because not all recordings have them: {NAMES[2]}" in result.stderr


@pytest.mark.parametrize(("column", "renamed"), [("Z [mm]", "Z_mm"), ("z_mm", "")])
def test_an_axis_position_that_no_configuration_can_name_is_told_at_training(
    tmp_path: Path, column: str, renamed: str
) -> None:
    """It was told by the replay alone, or by nobody until the daemon refused the configuration."""
    paths = [run(tmp_path, number) for number in (1, 2, 3)]
    for path in paths:
        head, *rows = path.read_text(encoding="utf-8").splitlines()
        moved = [f"{row},{100.0 + number % 50}" for number, row in enumerate(rows)]
        path.write_text("\n".join([f"{head},{column}", *moved]) + "\n", encoding="utf-8")
    (good := tmp_path / "map.yaml").write_text(
        f"time: t\nspeed: rpm\ntemperatures: ['T*']\naxis_positions: ['{column}']\ndisplacements: ['c*']\n",
        encoding="utf-8",
    )
    result = thermal("train", *paths, "--map", good, "--model", "ridge", "-o", tmp_path / "model.json")
    assert result.exit_code == 0, result.output
    said = f"axis position '{column}': no key of cnc.axis_positions may be called so"
    assert (said in result.stderr) is bool(renamed)
    assert not renamed or f"call the column {renamed} in the recordings and in the map" in result.stderr


def test_a_stuck_sensor_is_named_at_training(tmp_path: Path) -> None:
    result = thermal(
        "train",
        *runs(tmp_path, stuck=1),
        "--model",
        "ridge",
        "--map-out",
        tmp_path / "map.yaml",
        "-o",
        tmp_path / "m.json",
    )
    assert f"warning: tag2.csv: column {NAMES[1]}, row 10" in result.stderr
    assert "it seems stuck" in result.stderr


MAP = (
    "time: Uhrzeit\ndate: Datum\ntime_format: '%d.%m.%Y %H:%M:%S'\nspeed: Drehzahl [1/min]\n"
    "temperatures: ['Temp*°C*']\ndisplacements: ['Weg*']\ndecimal: ','\ntime_zone: Europe/Zurich\n"
)


def refusal(tmp_path: Path, text: str, recording_map: str = MAP) -> str:
    """Return what training says of one file, which it refuses."""
    (path := tmp_path / "tag.csv").write_text(text, encoding="utf-8")
    (given := tmp_path / "map.yaml").write_text(recording_map, encoding="utf-8")
    result = thermal("train", path, "--map", given, "--model", "ridge", "-o", tmp_path / "model.json")
    assert result.exit_code == 2, result.output
    return result.stderr


def test_what_is_refused_names_the_line_and_the_key_of_the_map_that_helps(tmp_path: Path) -> None:
    text = foreign(tmp_path / "tag.csv", 1).read_text("utf-8")
    head, first, *rows = text.splitlines()
    units = ";".join(["[d]", "[h]", "[1/min]", *4 * ["[°C]"], "[µm]"])
    said = refusal(tmp_path, "\n".join([head, units, first, *rows]) + "\n")
    assert "tag.csv:2: " in said and "unit_row: true" in said
    said = refusal(tmp_path, "\n".join(["# machine: mill-3", head, "", units, first, *rows]) + "\n")
    assert "tag.csv:4: " in said and "unit_row: true" in said
    for pattern in (NAMES[0], "Temp*C*"):  # the second one matches the garbled names as well
        said = refusal(tmp_path, text, MAP.replace("Temp*°C*", pattern) + "encoding: cp1252\n")
        assert "the file seems to be UTF-8 (" in said and NAMES[0] in said and "encoding: utf-8" in said
    still = [";".join([*row.split(";")[:-1], "0,01"]) for row in rows]
    said = refusal(tmp_path, "\n".join([head, *still]) + "\n")
    assert "displacement_units" in said and "record one in which the axis warms" in said


def test_a_recording_that_is_written_is_read_whatever_its_columns_are_called(tmp_path: Path) -> None:
    channels = ["Weg X, rel. [µm]", '1st "front"', "Z1"]
    columns = {name: (np.arange(4.0) + place, 3) for place, name in enumerate(["t", "T1", *channels])}
    write_recording(tmp_path / "tag.csv", {"machine": "m"}, columns)
    assert read_header(tmp_path / "tag.csv") == list(columns)
    recording_map = RecordingMap.model_validate({"time": "t", "temperatures": ["T1"], "displacements": channels})
    read = read_recording(tmp_path / "tag.csv", recording_map)
    assert read.displacement_names == tuple(channels)
    assert np.array_equal(read.displacements_um, np.column_stack([columns[name][0] for name in channels]))


@pytest.mark.parametrize(
    ("time", "texts", "sentence"),
    [
        ("Timestamp", ("05.02.2026 07:00",) * 2 + ("05.02.2026 07:01",) * 2, "says the same time in rows one after"),
        ("Date", ("5. Februar, 7h00", "5. Februar, 7h01"), "a time of a form that is not known: say it as time_format"),
    ],
)
def test_what_is_odd_about_a_time_is_told(tmp_path: Path, time: str, texts: tuple[str, ...], sentence: str) -> None:
    rows = "".join(f"{text};20,{number};1,5\n" for number, text in enumerate(texts))
    (tmp_path / "day.csv").write_text(f"{time};Temp 1;Weg Z [um]\n" + rows, encoding="utf-8")
    result = thermal("train", tmp_path / "day.csv", "-o", tmp_path / "m.json")
    assert (result.exit_code, sentence in result.stdout) == (2, True), result.output
    assert "none seems to be its time" in result.stderr


def test_a_map_that_a_person_has_corrected_is_not_written_over(tmp_path: Path) -> None:
    """The same command with --common-columns, as it asks for, took the corrections away."""
    files, path = runs(tmp_path), tmp_path / "map.yaml"
    arguments = ("train", *files, "--model", "ridge", "--map-out", path, "-o", tmp_path / "model.json")
    assert thermal(*arguments).exit_code == thermal(*arguments).exit_code == 0
    path.write_text(corrected := path.read_text(encoding="utf-8") + "time_zone: Europe/Berlin\n", encoding="utf-8")
    result = thermal(*arguments)
    assert (result.exit_code, "is there already" in result.stderr) == (2, True), result.output
    assert path.read_text(encoding="utf-8") == corrected


def test_a_japanese_logger_is_understood_in_its_own_encoding(tmp_path: Path) -> None:
    path = foreign(tmp_path / "day.csv", 1)
    words = {"Drehzahl [1/min]": "主軸回転数", "Weg Z [µm]": "変位Z", "Uhrzeit": "時刻", "Datum": "日付"}
    words |= {name: f"温度{number}(℃)" for number, name in enumerate(NAMES)}
    text = path.read_text(encoding="utf-8")
    for german, japanese in words.items():
        text = text.replace(german, japanese)
    path.write_text(text, encoding="cp932")
    proposed = thermal("train", path, "-o", tmp_path / "model.json")
    assert "encoding: cp932" in proposed.stdout and "time: 時刻" in proposed.stdout and "- 変位Z" in proposed.stdout
    made = thermal("train", path, "--map-out", tmp_path / "m.yaml", "--model", "ridge", "-o", tmp_path / "model.json")
    assert made.exit_code == 0, made.output
    assert model(tmp_path / "model.json").channels == ("変位Z",)


def test_what_has_no_usual_name_beside_usual_ones_is_named_and_the_proposed_map_reads_it(tmp_path: Path) -> None:
    paths = [run(tmp_path, number) for number in (1, 2, 3)]
    for path in paths:
        head, *rows = path.read_text(encoding="utf-8").splitlines()
        fields = [row.split(",") for row in rows]
        place = head.split(",").index("rpm")
        for row in fields:
            row[place] = f"{float(row[place]) / 1000.0:.4f}"
        path.write_text(
            "\n".join([head.replace("rpm", "speed [krpm]"), *map(",".join, fields)]) + "\n", encoding="utf-8"
        )
    plain = thermal("train", *paths, "--model", "ridge", "-o", tmp_path / "model.json")
    assert plain.exit_code == 0, plain.output
    assert "warning: not read, for want of a usual name: 'speed [krpm]'; --map-out map.yaml writes" in plain.stderr
    written = tmp_path / "map.yaml"
    result = thermal("train", *paths, "--model", "ridge", "--map-out", written, "-o", tmp_path / "model.json")
    assert result.exit_code == 0 and "not read" not in result.stderr, result.output
    proposed = load_recording_map(written)
    assert (proposed.speed, proposed.speed_unit) == ("speed [krpm]", "krpm")
    assert read_recording(paths[0], proposed).speed_rpm.max() > 1000.0


def test_the_command_that_a_refusal_advises_proposes_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    advised = recording_map._MAP_IT.split("`")[1].split()
    assert advised[:3] == ["toolpoint", "thermal", "train"]
    monkeypatch.chdir(tmp_path)
    foreign(tmp_path / "RECORDING", 1)
    result = thermal(*advised[2:], "--model", "ridge")
    assert "Missing option" not in result.stderr and (tmp_path / "map.yaml").is_file(), result.stderr


@pytest.mark.parametrize(("name", "encoding"), [("T{} [°F]", "utf-8"), ("T{}", "utf-16")])
def test_usual_names_with_a_unit_or_an_encoding_of_their_own_become_a_model_in_one_go(
    tmp_path: Path, name: str, encoding: str
) -> None:
    files = []
    for number in range(3):
        rows = [line.split(";")[2:] for line in foreign(tmp_path / "tag.csv", number).read_text("utf-8").splitlines()]
        header = ["time_s", "rpm", *(name.format(place) for place in range(1, 5)), "Z_um"]
        lines = [header, *([str(60 * minute), *fields] for minute, fields in enumerate(rows[1:]))]
        files.append(tmp_path / f"day{number}.csv")
        files[-1].write_text("\n".join(map(";".join, lines)), encoding=encoding)
    out = tmp_path / "map.yaml"
    result = thermal("train", *files, "--model", "ridge", "--map-out", out, "-o", tmp_path / "model.json")
    assert result.exit_code == 0, result.output
    units = {name.format(place): "degF" for place in range(1, 5)} if "F" in name else None
    assert (load_recording_map(out).temperature_units, load_recording_map(out).encoding) == (units, encoding)
