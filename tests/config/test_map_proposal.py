"""The map that is proposed for a recording whose columns carry no usual names."""

import pytest

from config.loader import parse_yaml_model
from config.recordings.map_proposal import MapProposal, propose_map
from config.recordings.recording_map import RecordingMap, resolve_columns

GERMAN = ["Datum", "Uhrzeit", "Drehzahl [1/min]", "Temp Spindel [°C]", "Temp. Bett (°C)", "Weg Z [µm]", "Leistung [kW]"]


def rows(*beginnings: str, fields: int, mark: str = ".") -> list[list[str]]:
    return [[*text.split("|"), *[f"{i}{mark}5" for i in range(fields - 1 - text.count("|"))]] for text in beginnings]


def german() -> MapProposal:
    return propose_map(GERMAN, rows("01.02.2026|07:00:00", "01.02.2026|07:00:10", fields=7, mark=","))


def test_a_foreign_header_becomes_a_map_that_reads_it() -> None:
    found = german()
    assert (found.lacking, found.left_out) == ((), ("Leistung [kW]",))
    proposed = found.recording_map
    assert (proposed.date, proposed.time, proposed.time_format) == ("Datum", "Uhrzeit", "%d.%m.%Y %H:%M:%S")
    assert (proposed.speed, proposed.decimal) == ("Drehzahl [1/min]", ",")
    columns = resolve_columns(proposed, GERMAN)
    assert (columns.temperatures, columns.displacements) == ([3, 4], [5])


def test_what_is_printed_is_the_map_with_what_a_person_must_look_at() -> None:
    text = german().yaml()
    assert parse_yaml_model(text, RecordingMap, "map.yaml") == german().recording_map
    assert "time_zone such as Europe/Zurich" in text and "leaves out: 'Leistung [kW]'" in text


@pytest.mark.parametrize(
    ("times", "form"),
    [
        (("2026-01-31 07:00:00", "2026-01-31 07:00:01"), {"time_unit": "iso"}),
        (("2026-01-31 07:00:00 PM", "2026-01-31 07:00:01 PM"), {"time_format": "%Y-%m-%d %I:%M:%S %p"}),
        (("2026年1月31日 7:00:00", "2026年1月31日 7:00:01"), {"time_format": "%Y年%m月%d日 %H:%M:%S"}),
        (("31.01.2026 07:00", "31.01.2026 07:01"), {"time_format": "%d.%m.%Y %H:%M"}),
        (("01/31/2026 07:00:00 AM", "01/31/2026 07:00:02 AM"), {"time_format": "%m/%d/%Y %I:%M:%S %p"}),
        (("07:00:00,5", "07:00:01,0"), {"time_format": "%H:%M:%S,%f"}),
        (("0", "10"), {"time_unit": "s"}),
    ],
)
def test_the_form_of_the_times_is_told_by_the_rows(times: tuple[str, str], form: dict[str, str]) -> None:
    keys = propose_map(["Timestamp", "T1 (degC)", "X [um]"], rows(*times, fields=3)).keys
    assert {key: keys[key] for key in keys if key in ("time_unit", "time_format")} == form


def test_a_row_of_units_says_what_the_columns_are() -> None:
    found = propose_map(
        ["time", "S1", "S2", "E"], [["min", "°C", "°C", "um"], ["0", "1", "2", "3"], ["1", "1", "2", "3"]]
    )
    assert found.recording_map == RecordingMap(
        time="time", time_unit="min", temperatures=["S1", "S2"], displacements=["E"], unit_row=True
    )


def test_a_row_of_units_may_end_before_the_last_column() -> None:
    found = propose_map(["time", "S1", "E", "Remark"], [["min", "°C", "um"], ["0", "1", "2", ""], ["1", "1", "2", ""]])
    assert found.keys["unit_row"] and found.left_out == ("Remark",)


def test_milliseconds_since_1970_are_told_by_their_number() -> None:
    found = propose_map(["timestamp", "T1", "X_um"], rows("1740985200000", "1740985210000", fields=3))
    assert (found.keys["time_unit"], found.lacking) == ("ms", ())
    assert found.notes == ("'timestamp' is taken to be milliseconds since 1970: the first row is of 03 March 2025",)
    finer = propose_map(["timestamp", "T1", "X_um"], rows("1740985200000000000", "1740985210000000000", fields=3))
    assert finer.keys["time_unit"] == "s", "which reading refuses"


def test_marks_that_separate_thousands_are_told_as_such() -> None:
    header = ["Temps [s]", "Vitesse broche (tr/min)", "T1", "X_um"]
    found = propose_map(header, [["980,0", "500", "20,1", "1,5"], ["1.000,0", "12\u00a0000", "20,2", "1,6"]])
    assert len(found.notes) == 2 and all("separates thousands; export" in note for note in found.notes)


def test_commas_in_some_numbers_and_points_in_others_are_told() -> None:
    header = ["t_s", "rpm", "T1", "X_um"]
    american = propose_map(header, [["0", "12,000", "20.1", "1.5"], ["1", "900", "20.2", "1.6"]])
    assert "decimal" not in american.keys and american.notes[0].startswith("'rpm' holds '12,000': a mark separates")
    german = propose_map(header, [["0", "12.000", "20,1", "1,5"], ["1", "900", "20,2", "1,6"]])
    assert german.keys["decimal"] == "," and german.notes[0].startswith("'rpm' holds '12.000': a mark separates")


def test_times_from_the_newest_to_the_oldest_are_told() -> None:
    found = propose_map(["Time [s]", "T1", "X_um"], rows("10", "0", fields=3))
    assert found.lacking == ("time",) and "where the newest row comes first, sort the rows" in found.notes[0]


def test_minutes_that_come_twice_are_said_once_and_no_date_is_blamed() -> None:
    fields = [["2025-03-03", "07:00", "20.1", "1"], ["2025-03-03", "07:00", "20.2", "2"]]
    (note,) = propose_map(["Date", "Time", "T1", "X_um"], fields).notes
    assert note.startswith("'Time' says the same time in rows one after the other")


def test_date_and_time_as_iso_8601_writes_them_may_stand_in_two_columns() -> None:
    found = propose_map(["Date", "Time", "T1", "X_um"], rows("2026-02-01|07:00:00", "2026-02-01|07:00:10", fields=4))
    assert {key: found.keys[key] for key in ("date", "time", "time_unit")} == {
        "date": "Date",
        "time": "Time",
        "time_unit": "iso",
    }
    assert found.notes[0].startswith("'Time' is taken to be in UTC")


def test_a_column_that_tells_when_a_probe_measured_is_no_displacement_and_a_word_is_no_standstill() -> None:
    fields = [[f"{10 * row}", "OFF" if row < 3 else "900", "20.1", f"{row % 3}", f"{row % 2}"] for row in range(12)]
    found = propose_map(["time_s", "speed", "T1", "Z_um", "probe trigger"], fields)
    assert found.keys["displacements"] == ["Z_um"] and found.left_out == ("probe trigger",)
    assert found.notes == ("'OFF' in 'speed' counts as missing: where it means that the spindle stands, write 0 there",)


def test_a_time_of_day_has_no_zone() -> None:
    found = propose_map(["Time", "T1", "X_um"], rows("07:00:00", "07:00:10", fields=3))
    assert (found.keys["time_format"], found.notes) == ("%H:%M:%S", ())
    assert not found.recording_map.local_times, "or a night when clocks were set back would ask for one"


@pytest.mark.parametrize("name", ["T1 (front)", "T07 Motor", "dT1", "dT12"])
def test_a_numbered_temperature_may_have_words_behind_it(name: str) -> None:
    assert propose_map(["time_s", name, "Z_um"], rows("0", "1", fields=3)).keys["temperatures"] == [name]


@pytest.mark.parametrize("name", ["DispZ", "tcp.dz", "Disp 1"])
def test_a_displacement_is_told_by_its_usual_abbreviations(name: str) -> None:
    assert propose_map(["time_s", "T1", name], rows("0", "1", fields=3)).keys["displacements"] == [name]


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t_min", "min"),
        ("Zeit/min", "min"),
        ("Minuten", "min"),
        ("elapsed minutes", "min"),
        ("時間[分]", "min"),
        ("Laufzeit [h]", "h"),
        ("Messzeit (Std)", "h"),
        ("time [d]", "d"),
        ("Sekunden", "s"),
    ],
)
def test_the_unit_of_the_time_is_what_its_name_says(name: str, unit: str) -> None:
    found = propose_map([name, "T1 (degC)", "X [um]"], rows("0", "1", "2", fields=3))
    assert (found.keys["time"], found.keys["time_unit"], found.notes) == (name, unit, ())


@pytest.mark.parametrize(("times", "said"), [(("0", "1"), "seconds, a row every 1 s; its"), (("0",), "seconds; its")])
def test_a_time_without_a_unit_is_questioned(times: tuple[str, ...], said: str) -> None:
    assert said in propose_map(["time", "T1", "X_um"], rows(*times, fields=3)).notes[0]


def test_temperatures_in_fahrenheit_and_kelvin_say_so_and_rises_in_kelvin_are_rises() -> None:
    header = ["time_s", "Oil [°F]", "Air (K)", "Rise [K]", "dz [um]"]
    found = propose_map(header, [["0", "68", "293.1", "0.0", "0"], ["60", "70", "293.4", "0.4", "1"]])
    assert found.keys["temperatures"] == header[1:4]
    assert found.keys["temperature_units"] == {"Oil [°F]": "degF", "Air (K)": "K"}
    counted = propose_map(["Time", "T1", "c1"], [["min", "F", "um"], ["0", "68", "0.1"], ["1", "70", "0.2"]])
    assert counted.keys["temperature_units"] == {"T1": "degF"}


def test_a_displacement_in_millimetres_says_so_and_an_axis_position_is_none() -> None:
    header = ["time_s", "T1", "Verlagerung Z [mm]", "dx_mm", "X [mm]", "Y [um]"]
    found = propose_map(header, rows("0", "1", fields=6))
    assert found.left_out == ("X [mm]",)
    columns = resolve_columns(found.recording_map, header)
    assert (columns.displacements, columns.displacement_units) == ([2, 3, 5], ["mm", "mm", "um"])
    assert columns.channels == ["Verlagerung Z", "dx", "Y [um]"], "figures of a channel are in micrometres"
    both = propose_map(["time_s", "T1", "dx [mm]", "dx (mm)"], rows("0", "1", fields=4))
    assert "displacement_names" not in both.keys


def test_what_no_name_tells_is_lacking_and_never_guessed() -> None:
    found = propose_map(["time", "foo", "power [kW]", "z [mm]"], rows("0", "1", fields=4))
    assert found.lacking == ("temperatures", "displacements")
    assert found.left_out == ("foo", "power [kW]", "z [mm]")
    assert "No column seems to be the temperatures; write it yourself" in found.yaml()
    filled_in = propose_map(["foo", "bar"], rows("a", "b", fields=2)).yaml()
    for key, value in {"time": "foo", "temperatures": "[foo]", "displacements": "[bar]"}.items():
        filled_in = filled_in.replace(f"# {key}:", f"{key}: {value}")
    assert parse_yaml_model(filled_in, RecordingMap, "map.yaml").time == "foo"


def test_a_dead_column_is_left_out_for_what_it_holds_and_not_for_its_name() -> None:
    header = ["time [s]", "Temp 1", "Temp 2", "Temp 3", "Temp 4", "X [um]", "Y [um]", "foo"]
    fields = [[str(n), "21.5", "OL", "", "21.5" if n else "---", "1.0", "---", "x"] for n in range(3)]
    found = propose_map(header, fields)
    assert (found.keys["temperatures"], found.keys["displacements"]) == (["Temp 1", "Temp 4"], ["X [um]"])
    assert found.keys["missing"] == ["---"], "what stands between numbers stands for a missing one"
    assert found.left_out == ("foo",), "the name of this one alone says nothing"
    dead, empty, channel = found.notes
    assert dead == "'Temp 2' is left out: none of its first 3 rows holds a number, row 1 'OL'; is its sensor broken?"
    assert "'Temp 3' is left out" in empty and "an empty field" in empty
    assert channel.startswith("'Y [um]' is left out: none of its first 3 rows holds a number, row 1 '---'")
    assert all(f"# {note}" in found.yaml() for note in found.notes)


def test_japanese_names_and_empty_fields_at_the_end_are_understood() -> None:
    header = ["日時", "主軸回転数", "温度1", "変位Z(μm)"]
    found = propose_map(
        header, [["2026/02/01 07:00:00", "0", "20.1", "1.5", ""], ["2026/02/01 07:01:30", "0", "20", "2", ""]]
    )
    expected = {"time": "日時", "time_format": "%Y/%m/%d %H:%M:%S", "speed": "主軸回転数", "temperatures": ["温度1"]}
    assert found.keys == expected | {"displacements": ["変位Z(μm)"]} and found.left_out == ()


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("Spindle speed (rad/s)", {"speed": "Spindle speed (rad/s)", "speed_unit": "rad/s"}),
        ("Drehzahl [1000/min]", {"speed": "Drehzahl [1000/min]", "speed_unit": "krpm"}),
        ("speed [krpm]", {"speed": "speed [krpm]", "speed_unit": "krpm"}),
        ("n [rps]", {}),
        ("Drehzahl [U/min]", {"speed": "Drehzahl [U/min]"}),
        ("spindle speed [%]", {}),
        ("feed speed [mm/min]", {}),
    ],
)
def test_the_unit_of_the_speed_is_said_and_what_does_not_turn_is_none(name: str, keys: dict[str, str]) -> None:
    found = propose_map(["t_s", name, "T1", "X_um"], rows("0", "1", fields=4)).keys
    assert {key: value for key, value in found.items() if key.startswith("speed")} == keys


@pytest.mark.parametrize(
    ("times", "form", "said"),
    [
        (("11/03/2025 09:30:00 AM", "11/03/2025 09:31:00 AM"), "%m/%d/%Y %I:%M:%S %p", "read as 03 November 2025"),
        (("11/03/2025 09:30", "11/03/2025 09:31"), "%d/%m/%Y %H:%M", "read as 11 March 2025"),
        (("03-Nov-25 09:30:00", "03-Nov-25 09:31:00"), "%d-%b-%y %H:%M:%S", "in UTC"),
        (
            ("3rd of May, 9h30", "3rd of May, 9h31"),
            None,
            "holds '3rd of May, 9h30', a time of a form that is not known",
        ),
    ],
)
def test_how_a_date_is_read_is_told(times: tuple[str, str], form: str | None, said: str) -> None:
    found = propose_map(["Date", "T1", "X_um"], rows(*times, fields=3))
    assert found.keys.get("time_format") == form and said in found.notes[0]


def test_a_column_with_a_unit_of_time_is_the_time_and_no_temperature() -> None:
    header = ["Tempo (s)", "Giri/min", "Temp. testa (°C)", "Scostamento interasse (µm)"]
    found = propose_map(header, [["0", "260", "26,4", "1,5"], ["1", "260", "26,5", "0,4"]])
    assert (found.lacking, found.left_out, found.notes) == ((), (), ())
    assert found.recording_map == RecordingMap(
        time="Tempo (s)",
        time_unit="s",
        speed="Giri/min",
        temperatures=["Temp. testa (°C)"],
        displacements=["Scostamento interasse (µm)"],
        decimal=",",
    )


@pytest.mark.parametrize(
    ("first", "said"),
    [("2026-03-26T06:30:00", True), ("2026-03-26T06:30:00Z", False), ("2026-03-26T06:30:00+02:00", False)],
)
def test_no_time_zone_is_asked_for_where_the_times_tell_it(first: str, said: bool) -> None:
    notes = propose_map(["timestamp", "T1", "X [um]"], [[first, "20.1", "0.0"]]).notes
    assert bool(notes) is said


def test_a_temperature_that_cannot_be_is_left_out_where_the_others_can() -> None:
    header = ["t", "Pt01 (°C)", "Pt02 (°C)", "Z [um]"]
    found = propose_map(header, [["0", "23.6", "3276.7", "0"], ["1", "23.7", "3276.7", "1"]])
    assert found.keys["temperatures"] == ["Pt01 (°C)"] and found.left_out == ()
    assert any("'Pt02 (°C)' is left out: it reads 3276.7" in note for note in found.notes)
    tenths = propose_map(header, [["0", "236", "231", "0"], ["1", "237", "231", "1"]])
    assert tenths.keys["temperatures"] == ["Pt01 (°C)", "Pt02 (°C)"], "a unit is wrong in all of them: reading says so"


def test_a_date_that_a_spreadsheet_counts_is_the_time() -> None:
    found = propose_map(["Datum", "T1", "X_um"], rows("46320.300000", "46320.300347", fields=3))
    assert (found.keys["time"], found.keys["time_unit"], found.lacking) == ("Datum", "d", ())
    assert propose_map(["Tag", "T1", "X_um"], rows("1", "2", fields=3)).lacking == ("time",)


def test_a_field_that_is_wrong_keeps_no_other_from_standing_for_a_missing_value() -> None:
    header = ["t_s", "T1", "T2", "X_um"]
    fields = ["20.1", "OL", "20.3", "#DIV/0!", "20.4", "20.5", "---", "20.6", "20.7", "20.8"]
    texts = [[str(second), text, "21.5", "0.1"] for second, text in enumerate(fields)]
    found = propose_map(header, texts)
    assert found.keys["missing"] == ["#DIV/0!", "---", "OL"] and found.keys["temperatures"] == ["T1", "T2"]
    found = propose_map(header, [*texts, ["10", "1.#QNAN", "3.4E38", "0.1"]])
    assert {"1.#QNAN", "3.4E38"} < set(found.keys["missing"])
    texts[4][1] = "2O.4"
    found = propose_map(header, texts)
    assert found.keys["missing"] == ["#DIV/0!", "---", "OL"] and found.keys["temperatures"] == ["T2"]
    assert found.notes[0].startswith("'T1' is left out: row 5 holds '2O.4', which is no number")


@pytest.mark.parametrize(("name", "step", "unit"), [("E25 (mm)", 0.0004, "mm"), ("Y [in]", 0.00001, "in")])
def test_a_length_that_moves_and_stays_near_zero_is_a_displacement(name: str, step: float, unit: str) -> None:
    def proposed(name: str, values: list[float]) -> MapProposal:
        texts = [[f"{10 * row}", "20.1", f"{value:.6f}"] for row, value in enumerate(values)]
        return propose_map(["time_s", "T1", name], texts)

    found = proposed(name, [0.002 + step * row for row in range(20)])
    assert found.keys["displacements"] == [name] and found.keys["displacement_units"] == {name: unit}
    assert found.notes[0].startswith(f"by their names {name!r} may be displacements or where axes stand")
    assert proposed(name, [250.0 + row for row in range(20)]).lacking == ("displacements",), "an axis that moves"
    assert proposed(name, [0.0] * 20).lacking == ("displacements",), "an axis that stands at zero"
    assert proposed(f"Pos {name}", [step * row for row in range(20)]).lacking == ("displacements",)


def test_nines_far_from_all_other_values_stand_for_a_missing_value() -> None:
    texts = [[f"{row}", "-9999" if row == 3 else f"{20.1 + row / 10:.1f}", f"{999 + row}"] for row in range(8)]
    texts[5][1] = "-9999.0"
    assert propose_map(["t_s", "T1", "X_um"], texts).keys["missing"] == ["-9999", "-9999.0"]
