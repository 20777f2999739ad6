"""`toolpoint dynamics` with files as a person writes them, good and bad."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from dynamics_command import DIRECT, answer, call, nose, refusal, write_csv

from config.machine.spindle import shipped_spindles, spindle_folder


def test_modes_on_bearings_and_free(spindle: Path, tmp_path: Path) -> None:
    held = answer("modes", spindle)
    free_file = tmp_path / "free.yaml"
    free_file.write_text(DIRECT.partition("  - {group")[0])
    free = answer("modes", free_file)
    assert (held["rigid_body_modes"], free["rigid_body_modes"]) == (0, 2)
    assert len(free["modes"]) == 6
    volume = sum(
        length * (outer**2 - inner**2)
        for length, outer, inner in [(15.1, 89, 42.4), (200, 60, 28), (11, 53, 32.3), (11, 85, 53), (220, 45, 32.3)]
    )
    assert free["mass_kg"] == pytest.approx(volume * np.pi / 4 * 7.85e-6)
    for mode in held["modes"]:
        assert len(mode["points_mm"]) == len(mode["shape"])
        assert (mode["points_mm"][0], mode["points_mm"][-1]) == (0.0, pytest.approx(446.1))
        assert max(np.abs(mode["shape"])) == pytest.approx(1.0)


def test_a_written_response_is_a_measurement_for_identification(spindle: Path, tmp_path: Path) -> None:
    path, old = tmp_path / "frf.csv", tmp_path / "old.csv"
    old.write_text("the last response", encoding="utf-8")
    path.hardlink_to(old)
    found = answer("frf", spindle, "--points", 400, "--csv", path)
    assert old.read_text(encoding="utf-8") == "the last response", "the file was written over, not put in one step"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table[:, 1].tolist() == found["receptance_re"]
    assert answer("identify", spindle, path, "--fixed", "file")["log_error"] < 1e-6
    assert "there is no folder" in refusal("frf", spindle, "--csv", tmp_path / "nowhere" / "frf.csv")


@pytest.mark.parametrize("parameters", ["5", "7"])
def test_identification_finds_what_the_response_was_made_with(spindle: Path, tmp_path: Path, parameters: str) -> None:
    true = {"kt_12": 1e-5, "ct_12": 2e3, "kr_12": 3e6, "kt_34": 1.4e8, "kr_34": 1e-5, "kt_5": 6e7, "ct_5": 2e3}
    if parameters == "7":
        true |= {"kt_12": 4e7, "kr_34": 2e5}
    lines = DIRECT.splitlines()[:-3]
    places = {"12": 99.1, "34": 184.1, "5": 400.1}
    for group, place in places.items():
        stated = {
            "kt_n_per_m": true[f"kt_{group}"],
            "ct_ns_per_m": true.get(f"ct_{group}", 1e-5),
            "kr_nm_per_rad": true.get(f"kr_{group}", 1e5),
            "cr_nms_per_rad": 1e-5,
        }
        entry = ", ".join(f"{name}: {value}" for name, value in stated.items())
        lines.append(f"  - {{group: '{group}', position_mm: {place}, {entry}}}")
    truth = tmp_path / "truth.yaml"
    truth.write_text("\n".join(lines))
    measured = write_csv(tmp_path / "measured.csv", *nose(truth))
    found = answer("identify", spindle, measured, "--parameters", parameters)
    assert set(found["values"]) == set(found["identifiable"])
    assert set(found["values"]) == ({"ct_12", "kr_12", "kt_34", "kt_5", "ct_5"} if parameters == "5" else set(true))
    for name, value in found["values"].items():
        assert value == pytest.approx(true[name], rel=1e-4), name
    assert found["cost"] < 1e-9
    assert found["fixed"]["kr_5"] == 1e5
    assert found["fixed_from"] == "source"
    told = call("identify", spindle, measured, "--parameters", parameters).stderr
    assert re.search(r"kt_34 +1.4000e\+08 N/m +1.\d+e\+08 to", told) and re.search(r"ct_5 +2.0000e\+03 N s/m ", told)
    assert re.search(r"kr_5 +1.0000e\+05 N m/rad +not varied, the published value: belongs to the others", told)


def test_twelve_parameters_are_found_again_but_not_all_determined(spindle: Path, tmp_path: Path) -> None:
    found = answer("identify", spindle, write_csv(tmp_path / "m.csv", *nose(spindle)), "--parameters", 12)
    assert len(found["values"]) == len(found["identifiable"]) == 12
    assert not all(found["identifiable"].values())
    assert found["evaluations"] < 10


def test_a_spindle_with_two_bearing_pairs_is_identified_without_a_choice(tmp_path: Path) -> None:
    *others, _ = DIRECT.splitlines()
    truth = tmp_path / "truth.yaml"
    truth.write_text("\n".join(others))
    measured = write_csv(tmp_path / "measured.csv", *nose(truth))
    guess = tmp_path / "guess.yaml"
    guess.write_text(truth.read_text().replace("5.11e7", "8e7").replace("1.7e8", "1e8"))
    assert answer("identify", guess, measured, "--parameters", "5")["log_error"] > 0.1
    found = answer("identify", guess, measured)
    assert found["parameters"] == 12 and len(found["values"]) == 8
    assert found["log_error"] < 1e-3
    told = call("identify", guess, measured).stderr
    assert "all parameters of the groups there are (12 and 34) are varied; --parameters 5 or 7 varies fewer" in told


def test_groups_named_as_the_published_ones_are_no_reason_to_keep_published_values(tmp_path: Path) -> None:
    own = DIRECT.replace("kr_nm_per_rad: 1e-5", "kr_nm_per_rad: 5e5").replace("kt_n_per_m: 1e-5", "kt_n_per_m: 1.6e8")
    truth = tmp_path / "truth.yaml"
    truth.write_text(own)
    measured = write_csv(tmp_path / "measured.csv", *nose(truth))
    guess = tmp_path / "guess.yaml"
    guess.write_text(own.replace("5.11e7", "8e7").replace("1.7e8", "1e8"))
    assert answer("identify", guess, measured, "--parameters", "5")["log_error"] > 0.05
    found = answer("identify", guess, measured)
    assert found["log_error"] < 1e-3 and found["fixed_from"] is None and len(found["values"]) == 12


def test_groups_have_any_names_and_a_person_says_what_varies(tmp_path: Path) -> None:
    truth = tmp_path / "truth.yaml"
    named = DIRECT.replace("'12'", "front").replace("'34'", "middle").replace("'5'", "rear")
    truth.write_text(named)
    measured = write_csv(tmp_path / "measured.csv", *nose(truth))
    guess = tmp_path / "guess.yaml"
    guess.write_text(named.replace("5.11e7", "8e7").replace("1.7e8", "1e8"))
    found = answer("identify", guess, measured, "--vary", "kt")
    assert found["values"] == pytest.approx({"kt_front": 5.11e7, "kt_middle": 1.7e8, "kt_rear": 9.11e7}, rel=1e-4)
    assert found["fixed_from"] == "file" and found["parameters"] == 3
    for name, value in found["values"].items():
        low, high = found["interval"][name]
        assert low <= value <= high
    assert answer("identify", guess, measured)["parameters"] == 12
    said = refusal("identify", guess, measured, "--vary", "kt_12")
    assert "'kt_12' is no bearing parameter of this spindle" in said and "kt_front" in said
    assert "name what is varied" in refusal("identify", guess, measured, "--parameters", "5")


def test_a_shaft_of_one_material_changes_by_the_root_of_its_moduli() -> None:
    found = answer("sensitivity", "steel", "--percent", 10, "--count", 2)
    assert found["varied_segments"] == list(range(1, 16))
    both = {each["percent"]: each["modes"] for each in found["variations"] if each["moduli"] == "E+G"}
    for percent, modes in both.items():
        for mode, before in zip(modes, found["baseline"], strict=True):
            assert mode["frequency_hz"] == pytest.approx(before["frequency_hz"] * (1 + percent / 100) ** 0.5, rel=1e-6)
            assert mode["change_percent"] == pytest.approx(100 * ((1 + percent / 100) ** 0.5 - 1), rel=1e-6)
            assert mode["mac"] == pytest.approx(1.0)
    assert set(both) == {10.0, -10.0}


def test_a_layout_twice_as_stiff_in_all_yields_half_at_root_two_of_the_frequency(spindle: Path, tmp_path: Path) -> None:
    text = DIRECT.replace("E_gpa: 200, G_gpa: 76.9", "E_gpa: 400, G_gpa: 153.8")
    for kind, factor in (
        ("kt_n_per_m", 2.0),
        ("kr_nm_per_rad", 2.0),
        ("ct_ns_per_m", 2**0.5),
        ("cr_nms_per_rad", 2**0.5),
    ):
        text = re.sub(
            rf"{kind}: ([\d.e]+)", lambda found, by=factor: f"{found[0].split()[0]} {float(found[1]) * by!r}", text
        )
    stiff = tmp_path / "stiff.yaml"
    stiff.write_text(text)
    found = answer("compare", spindle, stiff, "--from-hz", 200, "--to-hz", 4000, "--points", 40_000)
    first, second = found["layouts"]
    assert second["frequency_hz"] == pytest.approx(2**0.5 * first["frequency_hz"], rel=1e-3)
    assert (first["compliance_change_percent"], second["compliance_change_percent"]) == pytest.approx(
        (0.0, -50.0), abs=0.1
    )
    assert second["mass_kg"] == pytest.approx(first["mass_kg"])
    response = answer("frf", spindle, "--from-hz", 200, "--to-hz", 4000, "--points", 40_000)
    assert max(peak["magnitude_m_per_n"] for peak in response["peaks"]) == first["compliance_m_per_n"]
    assert not found["warnings"]
    higher = answer("compare", spindle, "--from-hz", 2.0 * first["frequency_hz"], "--to-hz", 4000)
    assert f"highest resonance lies at {first['frequency_hz']:.0f} Hz, outside" in higher["warnings"][0]


def test_a_laminate_has_the_shear_modulus_of_its_tube_however_it_is_written(tmp_path: Path) -> None:
    """By its name alone it had that of a full rod, 33.3 in place of 39.0 GPa: 154 Hz at the second mode."""
    found = []
    for told in ("material: cfrp_pm30", "mixture: {cfrp_pm30: 1}"):
        (tube := tmp_path / "tube.yaml").write_text(
            f"segments: [{{length_mm: 300, outer_mm: 53, inner_mm: 40, {told}}}]"
        )
        found.append([mode["frequency_hz"] for mode in answer("modes", tube, "--count", 2)["modes"]])
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_a_recording_of_numbered_sensors_is_told_how_they_get_labels(tmp_path: Path) -> None:
    recording = tmp_path / "day.csv"
    recording.write_text("t,T1,T2\n0,20,20\n60,20,20\n")
    result = call("track", recording, "--spindle", "tool_warm_y")
    assert result.exit_code == 2
    assert "no sensor carries the label A, F, IR, Room" in result.stderr and "--config names" in result.stderr


def test_after_a_gap_results_are_as_far_apart_as_before(tmp_path: Path) -> None:
    """What had been due in the gap came after it, row by row."""
    recording = tmp_path / "day.csv"
    rows = [f"{60 * minute},20,20,20,20" for minute in (*range(7), *range(30, 40))]
    recording.write_text("\n".join(["t,IR,A,F,Room", *rows]) + "\n")
    found = answer("track", recording, "--spindle", "tool_warm_y", "--axis", "y", "--every-min", 3)
    assert found["time_min"] == [0, 3, 6, 30, 33, 36, 39]


def test_what_is_followed_over_a_recording_is_the_peak_on_the_bearings_of_its_temperatures(tmp_path: Path) -> None:
    recording = tmp_path / "day.csv"
    rows = [f"{60 * minute},20,20,20,20" for minute in range(15)]
    recording.write_text("\n".join(["t,IR,A,F,Room", *rows]) + "\n")
    found = answer("track", recording, "--spindle", "tool_warm_y", "--axis", "y")
    assert found["time_min"] == list(range(15))
    assert all(found["inhibit"][:10]) and not any(found["inhibit"][10:]), (
        "the changes over 10 min are known from then on"
    )
    axis = found["axes"]["y"]
    of_bearings = answer("bearings", "--axis", "y", "--t-ir", 20, "--t-a", 20, "--t-f", 20, "--t-room", 20)
    assert {name: each["value"][-1] for name, each in axis["properties"].items()} == pytest.approx(
        {name: each["value"] for name, each in of_bearings.items()}
    )
    kept = {"kt_12": 1e-5, "ct_34": 1e-5, "kr_34": 1e-5, "cr_12": 1e-5, "cr_34": 1e-5, "cr_5": 1e-5, "kr_5": 1e5}
    values = kept | {name: each["value"] for name, each in of_bearings.items()}
    content = yaml.safe_load((spindle_folder() / "tool_warm_y.yaml").read_text())
    for bearing in content["bearings"]:
        for key in ("kt_n_per_m", "ct_ns_per_m", "kr_nm_per_rad", "cr_nms_per_rad"):
            bearing[key] = values[f"{key[:2]}_{bearing['group']}"]
    own = tmp_path / "own.yaml"
    own.write_text(yaml.safe_dump(content))
    response = answer("frf", own, "--at", "tool", "--df", 0.1)
    highest = max(response["peaks"], key=lambda peak: peak["magnitude_m_per_n"])
    assert axis["resonance_hz"] == pytest.approx([highest["frequency_hz"]] * 15, abs=0.2), "lines are 0.8 Hz apart"
    on_lines = max(peak["magnitude_m_per_n"] for peak in answer("frf", own, "--at", "tool")["peaks"])
    assert on_lines <= axis["magnitude_m_per_n"][-1] <= highest["magnitude_m_per_n"]
    assert axis["continuous"] == [True] * 15


def test_pictures(spindle: Path, tmp_path: Path) -> None:
    measured = write_csv(tmp_path / "m.csv", *nose(spindle, "--points", 300))
    calls: dict[str, list[object]] = {
        "modes": ["modes", "tool_cold_y", "--count", 2],
        "frf": ["frf", spindle, "--points", 200],
        "identify": ["identify", spindle, measured, "--fixed", "file"],
        "sensitivity": ["sensitivity", "model_2"],
        "compare": ["compare", "unit_model_5_y", spindle, "--points", 200],
    }
    for name, arguments in calls.items():
        path = tmp_path / f"{name}.{'png' if name in ('modes', 'compare') else 'html'}"
        answer(*arguments, "--picture", path)
        start = path.read_bytes()[:200]
        assert start.startswith(b"\x89PNG") if path.suffix == ".png" else b"<html" in start
        assert path.stat().st_size > 10_000
    assert "its name ends in .png or .html" in refusal("modes", spindle, "--picture", tmp_path / "p.gif")


@pytest.mark.parametrize("name", shipped_spindles())
def test_every_shipped_spindle_can_be_computed(name: str) -> None:
    assert all(mode["frequency_hz"] > 300 for mode in answer("modes", name, "--count", 2)["modes"])
