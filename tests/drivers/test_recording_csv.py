"""Recordings as files: maps, formats, and errors with file, line and column."""

from pathlib import Path

import numpy as np
import pytest

from config.recordings.recording_map import RecordingMap, load_recording_map, usual_map
from config.schema.base import ConfigurationError
from drivers.files.recording_csv import read_recording
from drivers.files.recording_lines import RecordingFileError

MAP = RecordingMap(time="t", speed="rpm", temperatures=["t*"], displacements=["c*"])
GOOD = "t,rpm,c1,t1,t2\n0,0,0.5,20,21\n15,1250,0.75,20.5,21.25\n"


def written(folder: Path, content: str | bytes, name: str = "day.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refusal(folder: Path, content: str | bytes, recording_map: RecordingMap | None = MAP) -> str:
    with pytest.raises(RecordingFileError) as raised:
        read_recording(written(folder, content), recording_map)
    return str(raised.value).removeprefix(str(folder) + "/")


def test_columns_are_read_by_the_map(tmp_path: Path) -> None:
    recording = read_recording(written(tmp_path, GOOD), MAP)
    assert (recording.temperature_names, recording.displacement_names) == (("t1", "t2"), ("c1",))
    np.testing.assert_array_equal(recording.time_s, [0.0, 15.0])
    np.testing.assert_array_equal(recording.speed_rpm, [0.0, 1250.0])
    np.testing.assert_array_equal(recording.temperatures_degc, [[20.0, 21.0], [20.5, 21.25]])
    np.testing.assert_array_equal(recording.displacements_um, [[0.5], [0.75]])


def test_names_that_a_spreadsheet_breaks_into_lines_are_one_name_each(tmp_path: Path) -> None:
    content = '"t","Speed\r\n[rpm]","Temp 1\n[°C]","Z [µm]"\r\n0,0,20,1\r\n15,x,20,1\r\n'
    given = RecordingMap(time="t", speed="Speed [rpm]", temperatures=["Temp 1 [°C]"], displacements=["Z [µm]"])
    assert "day.csv:5: column Speed [rpm]: 'x' is not a number" in refusal(tmp_path, content, given)
    assert read_recording(written(tmp_path, content.replace("x", "9")), given).rows == 2
    assert "does not look like the names" in refusal(tmp_path, '"t\n' + "0,1,2,3\n" * 30, given)


def test_without_a_map_the_usual_names_are_understood(tmp_path: Path) -> None:
    recording = read_recording(written(tmp_path, GOOD))
    assert (recording.temperature_names, recording.displacement_names) == (("t1", "t2"), ("c1",))
    assert usual_map(["time_h", "speed_rpm", "T1", "Y1", "Z2"]).displacements == ["[XYZ][0-9]*"]
    assert "no column carries a usual name for displacements" in refusal(tmp_path, "t,t1\n0,20\n", None)
    assert "time: no column carries a usual name" in refusal(tmp_path, "clock,t1,c1\n0,20,1\n", None)


def test_millimetres_and_names_of_channels_are_what_the_map_says(tmp_path: Path) -> None:
    content = "t,dz [mm],dy [mm],c1,t1\n0,0.001,0.002,0.5,20\n15,,-0.003,0.75,21\n"
    keys = {"time": "t", "temperatures": ["t1"], "displacements": ["dz [mm]", "dy [mm]", "c1"]}
    units, names = {"dz [mm]": "mm", "dy*": "mm"}, {"dz [mm]": "Z1"}
    read = read_recording(
        written(tmp_path, content),
        RecordingMap.model_validate(keys | {"displacement_units": units, "displacement_names": names}),
    )
    assert read.displacement_names == ("Z1", "dy [mm]", "c1")
    np.testing.assert_allclose(read.displacements_um, [[1.0, 2.0, 0.5], [np.nan, -3.0, 0.75]])
    for key, value, sentence in (
        ("displacement_units", {"t1": "mm"}, "displacement_units: no displacement column matches 't1'"),
        ("displacement_names", {"t1": "Z1"}, "displacement_names: 't1' is no displacement column"),
        ("displacement_names", {"dz [mm]": "c1"}, "displacement_names: two columns would be called 'c1'"),
    ):
        assert sentence in refusal(tmp_path, content, RecordingMap.model_validate(keys | {key: value}))


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + GOOD.encode(),
        GOOD.replace("\n", "\r\n").encode(),
        GOOD.replace(",", ";").replace(".", ",").encode(),
        GOOD.replace(",", "\t").encode(),
        GOOD.replace("\n", "\n\n").encode(),
        GOOD.replace(",", " , ").encode(),
        GOOD.replace("t1", '"t1"').encode(),
        GOOD.rstrip("\n").encode(),
    ],
)
def test_usual_dialects_give_the_same_numbers(tmp_path: Path, content: bytes) -> None:
    recording = read_recording(written(tmp_path, content), MAP)
    np.testing.assert_array_equal(recording.temperatures_degc, [[20.0, 21.0], [20.5, 21.25]])
    np.testing.assert_array_equal(recording.time_s, [0.0, 15.0])


@pytest.mark.parametrize(
    ("unit", "first", "second"),
    [
        ("s", "100", "115"),
        ("min", "2", "2.25"),
        ("h", "1.0", "1.0041666666666667"),
        ("iso", "2026-03-01T08:00:00", "2026-03-01T08:00:15"),
        ("iso", "2026-03-01 08:00:00+01:00", "2026-03-01T07:00:15Z"),
    ],
)
def test_times_count_from_the_first_row_in_seconds(tmp_path: Path, unit: str, first: str, second: str) -> None:
    content = f"when,c1,t1\n{first},1,20\n{second},1,20\n"
    recording_map = RecordingMap(time="when", time_unit=unit, temperatures=["t1"], displacements=["c1"])  # type: ignore[arg-type]
    recording = read_recording(written(tmp_path, content), recording_map)
    np.testing.assert_allclose(recording.time_s, [0.0, 15.0], atol=1e-6)
    assert recording.speed_rpm is None


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "day.csv: has no header row"),
        ("\n1,2\n", "day.csv:1: has no header row"),
        ("0,1,2\n", "day.csv:1: begins with numbers"),
        ("t,rpm,c1,t1,t1\n", "day.csv:1: 't1' is the name of several columns; give"),
        ("t,rpm,c1,t1,t2\n", "day.csv:1: holds no rows"),
        ("t,rpm,c1,x\n0,0,0,0\n", "day.csv:1: temperatures: no column matches 't*'; the columns are t, rpm, c1, x"),
        ("t,c1,t1\n0,0,0\n", "day.csv:1: speed: there is no column 'rpm'"),
        (GOOD + "30,0,1,20\n", "day.csv:4: has 4 fields where the header has 5"),
        (GOOD + "30,0,abc,20,21\n", "day.csv:4: column c1: 'abc' is not a number"),
        (GOOD + "30,5'903,1,20,21\n", '"5\'903" is not a number; where a mark separates thousands, export'),
        (
            GOOD + "30,0,1,20.5 °C,21\n",
            "column t1: '20.5 °C' is not a number; write the number alone, and its unit into",
        ),
        (
            GOOD + "30,0,1,20,inf\n",
            "day.csv:4: column t2: 'inf' is not a possible value; where it stands for a missing",
        ),
        (b"PK\x03\x04\x14\x00\x06\x00", "day.csv: is a workbook of a spreadsheet, no CSV: save the sheet as CSV"),
        (GOOD + "30,0,1,20,-1e308\n", "day.csv:4: column t2: '-1e308' is not a possible value"),
        (GOOD + ",0,1,20,21\n", "day.csv:4: column t: is empty; every row needs its time"),
        (GOOD + "nan,0,1,20,21\n", "day.csv:4: column t: 'nan' is not a time"),
        (GOOD + "15,0,1,20,21\n", "day.csv:4: column t: '15' does not come after the row before; the same time"),
        (
            GOOD + "9,0,1,20,21\n",
            "day.csv:4: column t: '9' does not come after the row before; sort the rows, and split",
        ),
        (
            "t,rpm,c1,t1,t2\n9,0,1,2,3\n0,0,1,2,3\n",
            "day.csv:3: column t: '0' does not come after the row before; where",
        ),
        (GOOD + "t,rpm,c1,t1,t2\n", "day.csv:4: the names of the columns come again; split the file where"),
        (
            "Logger 7\nMill;3\n" + GOOD,
            "day.csv:1: 'Logger 7' does not look like the names of the columns; where line 3",
        ),
        (
            "Logger 7\nCH,Name,Input,Range\n1,Nose,TC,100\n" + GOOD,
            "day.csv:1: 'Logger 7' does not look like the names of the columns; where line 4 holds them",
        ),
        (GOOD.encode() + b"30,0,\xff,20,21\n", "is not UTF-8"),
        (GOOD.encode() + b"30,0,\x00,20,21\n", "day.csv:4: holds a NUL byte"),
        (",".join(f"x{i}" for i in range(5000)) + "\n", "day.csv:1: has 5000 columns"),
        (GOOD + '30,0,"' + "9" * 200_000 + "\n", "is not CSV"),
        ("x" * 200_000, "day.csv:1: is not CSV"),
    ],
)
def test_errors_name_file_line_and_column(tmp_path: Path, content: str | bytes, sentence: str) -> None:
    assert sentence in refusal(tmp_path, content)


def test_a_map_is_yaml_with_errors_by_line_and_key(tmp_path: Path) -> None:
    small = '{time: t, time_unit: s, speed: rpm, temperatures: ["t*"], displacements: ["c*"], sample_s: 60}\n'
    assert load_recording_map(written(tmp_path, small, "map.yaml")) == MAP
    bad = "time: t\ntemperatures: [t1]\ndisplacements: [c1]\ntime_unit: days\ncolour: red\n"
    with pytest.raises(ConfigurationError) as raised:
        load_recording_map(written(tmp_path, bad, "bad.yaml"))
    text = str(raised.value)
    assert "bad.yaml:4:" in text and "time_unit" in text
    assert "bad.yaml:5:1: colour" in text


def test_metadata_alone_are_no_recording_and_errors_count_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "day.csv"
    path.write_text("# machine: mill 7\n", encoding="utf-8")
    with pytest.raises(RecordingFileError, match="no header row"):
        read_recording(path)
    path.write_text("# machine: mill 7\n# a\nt,t1,c1\n0,20,1\n60,warm,1\n", encoding="utf-8")
    with pytest.raises(RecordingFileError, match=r"day\.csv:5: column t1: 'warm' is not a number"):
        read_recording(path)


def times(folder: Path, *texts: str, **keys: str) -> list[float]:
    rows = "".join(f"{text};20,5;1,5\n" for text in texts)
    found = read_recording(
        written(folder, "when;T 1 [degC];Z (um)\n" + rows),
        RecordingMap(time="when", temperatures=["T 1 [degC]"], displacements=["Z (um)"], **keys),  # type: ignore[arg-type]
    )
    assert found.temperatures_degc[0, 0] == 20.5
    return [float(time_s) for time_s in found.time_s]


def test_times_are_read_in_the_form_and_the_zone_of_the_map(tmp_path: Path) -> None:
    form = {"time_format": "%d.%m.%Y %H:%M:%S"}
    assert times(tmp_path, "31.01.2026 23:59:50", "01.02.2026 00:00:00", **form) == [0.0, 10.0]
    assert times(tmp_path, "23:59:50", "00:00:10", time_format="%H:%M:%S") == [0.0, 20.0]
    since_start = "0:00:00", "23:59:50", "24:00:00", "47:59:59", "100:00:00"
    read = times(tmp_path, *since_start, time_format="%H:%M:%S")
    assert read == [0.0, 86_390.0, 86_400.0, 172_799.0, 360_000.0], "hours since the start go on past 24"
    zurich = form | {"time_zone": "Europe/Zurich"}
    spring = "29.03.2026 01:59:00", "29.03.2026 03:00:00"
    assert (times(tmp_path, *spring, **zurich), times(tmp_path, *spring, **form)) == ([0.0, 60.0], [0.0, 3660.0])
    autumn = "25.10.2026 02:30:00", "25.10.2026 02:50:00", "25.10.2026 02:10:00", "25.10.2026 03:00:00"
    assert times(tmp_path, *autumn, **zurich) == [0.0, 1200.0, 2400.0, 5400.0]
    iso = {"time_unit": "iso", "time_zone": "Europe/Zurich"}
    assert times(tmp_path, "2026-03-29T01:59:00", "2026-03-29T03:00:00", **iso) == [0.0, 60.0]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"time_zone": "Europe/Zurich"}, "time_zone: a time in s has no zone"),
        ({"time_unit": "iso", "time_zone": "Mars"}, "time_zone: 'Mars' is no zone of this computer"),
        (
            {"time_unit": "h", "time_format": "%H:%M"},
            "time_unit: goes with numbers and with ISO 8601, not with time_format",
        ),
        (
            {"time_format": "%H:%M:%S", "time_zone": "Europe/Zurich"},
            "time_zone: a time of day without a date has no zone",
        ),
        ({"time_format": "dd.mm"}, "time_format: 'dd.mm' has no part such as %H"),
        ({"date": "day"}, "date: needs time_format"),
    ],
)
def test_a_map_whose_times_cannot_be_is_refused_by_key(tmp_path: Path, keys: dict[str, str], sentence: str) -> None:
    text = "time: t\ntemperatures: [t1]\ndisplacements: [c1]\n" + "".join(f"{k}: '{v}'\n" for k, v in keys.items())
    with pytest.raises(ConfigurationError) as raised:
        load_recording_map(written(tmp_path, text, "map.yaml"))
    assert sentence in str(raised.value)


@pytest.mark.parametrize("code", ["-9999", "99.9", "1e30", "OL"])
def test_what_the_map_names_as_missing_is_that_also_where_it_is_a_number(tmp_path: Path, code: str) -> None:
    read = read_recording(
        written(tmp_path, GOOD + f"30,1250, {code},20.5,{code}\n"), MAP.model_copy(update={"missing": [code]})
    )
    np.testing.assert_array_equal(read.temperatures_degc[-1], [20.5, np.nan])
    np.testing.assert_array_equal(read.displacements_um[-1], [np.nan])


def test_decimal_commas_in_quoted_fields_need_the_map(tmp_path: Path) -> None:
    content = 't,t1,c1\n0,"20,5","-1,25"\n'
    keys = {"time": "t", "temperatures": ["t1"], "displacements": ["c1"]}
    found = read_recording(written(tmp_path, content), RecordingMap.model_validate(keys | {"decimal": ","}))
    assert (found.temperatures_degc[0, 0], found.displacements_um[0, 0]) == (20.5, -1.25)
    assert "say decimal: ',' in the map" in refusal(tmp_path, content, RecordingMap.model_validate(keys))
    dotted = RecordingMap.model_validate(keys | {"decimal": ","})
    assert "'20.5' is not a number; the map says" in refusal(tmp_path, "t,t1,c1\n0,20.5,1\n", dotted)
    speeds = "t;rpm;t1;c1\n0;{};{};1\n"
    for speed, degc in (("12,000", "20.5"), ("30.000", "20,5")):
        said = refusal(tmp_path, speeds.format(speed, degc), None)
        assert "has a comma and" in said and repr(speed) in said, "12 1/min or 12 thousand: nobody knows"
    marks = RecordingMap.model_validate(keys | {"decimal": ","})
    assert "'1.020,0' is not a number; where a mark" in refusal(tmp_path, "t;t1;c1\n0;1.020,0;1\n", marks)
    assert "'1.020,0' has a mark that separates" in refusal(tmp_path, "t;t1;c1\n1.020,0;20,5;1\n", marks)


def test_milliseconds_since_1970_are_never_seconds(tmp_path: Path) -> None:
    content = "t,c1,t1\n1740985200000,0.5,20\n1740985210000,0.75,20.5\n"
    said = refusal(tmp_path, content, None)
    assert said == "day.csv: column t: no seconds since 1970 are so many: say time_unit: ms in the map"
    keys = {"time": "t", "time_unit": "ms", "temperatures": ["t1"], "displacements": ["c1"]}
    milliseconds = RecordingMap.model_validate(keys)
    assert read_recording(written(tmp_path, content), milliseconds).time_s.tolist() == [0.0, 10.0]
    assert "convert" in refusal(tmp_path, content.replace("0000,", "0000000,"), milliseconds)


def test_times_speeds_and_displacements_are_read_in_the_unit_that_the_map_says(tmp_path: Path) -> None:
    keys = {
        "time": "t",
        "speed": "n",
        "temperatures": ["T1"],
        "displacements": ["z"],
        "displacement_units": {"z": "in"},
    }
    content = "t,n,T1,z\n1000,12,20,0.001\n3500,0.5,21,0\n"
    for unit, rpm in (("krpm", 12000.0), ("1/s", 720.0), ("rad/s", 114.5915590)):
        found = read_recording(
            written(tmp_path, content), RecordingMap.model_validate(keys | {"time_unit": "ms", "speed_unit": unit})
        )
        assert found.time_s.tolist() == [0.0, 2.5] and found.displacements_um[0, 0] == pytest.approx(25.4)
        assert found.speed_rpm is not None and found.speed_rpm[0] == pytest.approx(rpm)


@pytest.mark.parametrize(
    ("name", "said", "sentence"),
    [
        (
            "n [krpm]",
            {},
            "column 'n [krpm]' is in krpm, by its name, and is read in 1/min: say speed_unit: krpm",
        ),
        ("n (rad/s)", {}, "say speed_unit: rad/s in the map"),
        ("n [%]", {}, "column 'n [%]' is in %, by its name, and is read in 1/min: convert it to 1/min, or take it out"),
        ("n [krpm]", {"speed_unit": "krpm"}, ""),
        ("n [1/min]", {}, ""),
    ],
)
def test_a_speed_in_another_unit_than_it_is_read_in_is_refused(
    tmp_path: Path, name: str, said: dict[str, str], sentence: str
) -> None:
    keys = {"time": "t", "speed": name, "temperatures": ["T1"], "displacements": ["z"]} | said
    content = f"t,{name},T1,z\n0,12,20,1\n60,12,20,1\n"
    if sentence:
        assert sentence in refusal(tmp_path, content, RecordingMap.model_validate(keys))
    else:
        assert read_recording(written(tmp_path, content), RecordingMap.model_validate(keys)).speed_rpm is not None


def test_a_day_that_is_read_as_a_month_is_told(tmp_path: Path) -> None:
    content = "t,T1,z\n11/03/2025 23:59,20,1\n11/04/2025 00:00,20,1\n"
    keys = {"time": "t", "temperatures": ["T1"], "displacements": ["z"]}
    said = refusal(tmp_path, content, RecordingMap.model_validate(keys | {"time_format": "%d/%m/%Y %H:%M"}))
    assert said.startswith("day.csv:3: column t: '11/04/2025 00:00' comes a month after the row before: are %d and %m")
    right = read_recording(tmp_path / "day.csv", RecordingMap.model_validate(keys | {"time_format": "%m/%d/%Y %H:%M"}))
    assert right.time_s.tolist() == [0.0, 60.0]


ROW_OF_UNITS = "Zeit;Öl;Weg\nmin;°C;mm\n0;20,5;0,001\n1;20,6;0,002\n"


@pytest.mark.parametrize(
    ("units", "said", "sentence"),
    [
        ("min;°C;mm", {}, "column 'Zeit' is in min, by the row of units, and is read in s: say time_unit: min in the"),
        ("[s];[°C];[mm]", {}, "column 'Weg' is in mm, by the row of units, and is read in um: say displacement_units:"),
        ("sec;°C;µm", {"displacement_units": {"Weg": "mm"}}, "say displacement_units: {'Weg': um} in the map"),
        ("h;°C;um", {"time_unit": "min"}, "say time_unit: h in the map"),
        ("ms;°C;um", {}, "column 'Zeit' is in ms, by the row of units, and is read in s: say time_unit: ms in the map"),
        ("s;°F;um", {}, "temperatures: column 'Öl' is in degF, by the row of units, and is read in degC: say temper"),
        ("s;°C;um", {"temperature_units": {"Öl": "degF"}}, "say temperature_units: {'Öl': degC} in the map"),
        (
            "s;°C;inch",
            {},
            "'Weg' is in in, by the row of units, and is read in um: say displacement_units: {'Weg': in}",
        ),
        ("s;um;°C", {}, "column 'Weg' is in degC"),
    ],
)
def test_a_row_of_units_that_contradicts_the_map_is_refused(
    tmp_path: Path, units: str, said: dict[str, object], sentence: str
) -> None:
    keys = {"time": "Zeit", "temperatures": ["Öl"], "displacements": ["Weg"], "unit_row": True} | said
    found = refusal(tmp_path, ROW_OF_UNITS.replace("min;°C;mm", units), RecordingMap.model_validate(keys))
    assert found.startswith("day.csv:2: ") and sentence in found


def test_a_unit_in_a_name_counts_where_the_map_does_not_say_the_unit(tmp_path: Path) -> None:
    content = "Zeit [min],T_in,dz (mm)\n0,20,0.001\n1,21,0.002\n"
    keys = {"time": "Zeit [min]", "temperatures": ["T_in"], "displacements": ["dz (mm)"]}
    of_time = refusal(tmp_path, content, RecordingMap.model_validate(keys))
    assert (
        "'Zeit [min]' is in min, by its name, and is read in s: say time_unit: min in the map, or time_unit: s"
        in of_time
    )
    keys |= {"time_unit": "s"}
    assert "'dz (mm)' is in mm, by its name" in refusal(tmp_path, content, RecordingMap.model_validate(keys))
    said = RecordingMap.model_validate(keys | {"displacement_units": {"dz*": "um"}})
    assert read_recording(written(tmp_path, content), said).displacements_um[1, 0] == 0.002
    usual = refusal(tmp_path, "t,t1,c1_mm\n0,20,0.001\n", None)
    assert "column 'c1_mm' is in mm, by its name, and is read in um" in usual


@pytest.mark.parametrize(
    ("unit", "values", "degc"),
    [
        ("degF", ("68", "77"), (20.0, 25.0)),
        ("K", ("293.15", "294.15"), (20.0, 21.0)),
        ("degC", ("20", "21"), (20.0, 21.0)),
        ("degF", ("0", "9"), (0.0, 5.0)),  # rises since the start
        ("K", ("0", "5"), (0.0, 5.0)),
    ],
)
def test_temperatures_in_other_units_are_read_in_degrees_celsius(
    tmp_path: Path, unit: str, values: tuple[str, str], degc: tuple[float, float]
) -> None:
    """An axis position beside them stays as it is."""
    content = f"t,T1,Z,c1\n0,{values[0]},100,0\n60,{values[1]},200,1\n"
    keys = {"time": "t", "temperatures": ["T1"], "axis_positions": ["Z"], "displacements": ["c1"]}
    given = RecordingMap.model_validate(keys | {"temperature_units": {"T*": unit}})
    found = read_recording(written(tmp_path, content), given)
    np.testing.assert_allclose(found.temperatures_degc, np.column_stack([degc, (100.0, 200.0)]), atol=1e-9)


def test_dates_as_a_spreadsheet_counts_them_are_days_and_never_seconds(tmp_path: Path) -> None:
    content = "t,c1,t1\n45992.3125,0.5,20\n45992.3128472,0.75,20.5\n45992.3131944,1,21\n"
    said = refusal(tmp_path, content, None)
    assert (
        said
        == "day.csv: column t: 45992.3125 and so on are days, as spreadsheets count dates: say time_unit: d in the map"
    )
    days = RecordingMap(time="t", time_unit="d", temperatures=["t1"], displacements=["c1"])
    read = read_recording(written(tmp_path, content), days)
    np.testing.assert_allclose(read.time_s, [0.0, 30.0, 60.0], atol=0.01)
    later = "t,c1,t1\n45992,0.5,20\n46022,0.75,20.5\n"
    assert read_recording(written(tmp_path, later)).time_s.tolist() == [0.0, 30.0], "seconds since midnight"
