"""`toolpoint dynamics` with files as a person writes them, good and bad."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from config.spindle import shipped_spindles
from daemon.cli import main
from daemon.cli.dynamics_options import PICTURE_LIBRARIES

STEEL = "E_gpa: 200, G_gpa: 76.9, nu: 0.3, density_g_cm3: 7.85"
TURNING = "kr_nm_per_rad: 2.96e5, cr_nms_per_rad: 0.0338"
DIRECT = f"""\
structural_damping: 0.0029
segments:
  - {{length_mm: 15.1, outer_mm: 89.0, inner_mm: 42.4, {STEEL}}}
  - {{length_mm: 200.0, outer_mm: 60.0, inner_mm: 28.0, {STEEL}}}
  - {{length_mm: 11.0, outer_mm: 53.0, inner_mm: 32.3, {STEEL}, ring: {{outer_mm: 85.0, {STEEL}}}}}
  - {{length_mm: 220.0, outer_mm: 45.0, inner_mm: 32.3, {STEEL}}}
bearings:            # none: free-free
  - {{group: '12', position_mm: 99.1, kt_n_per_m: 5.11e7, ct_ns_per_m: 1198, {TURNING}}}
  - {{group: '34', position_mm: 184.1, kt_n_per_m: 1.7e8, ct_ns_per_m: 900, {TURNING}}}
  - {{group: '5', position_mm: 400.1, kt_n_per_m: 9.11e7, ct_ns_per_m: 1500, {TURNING}}}
"""
FREE = DIRECT.partition("bearings:")[0]


@pytest.fixture
def spindle(tmp_path: Path) -> Path:
    path = tmp_path / "spindle.yaml"
    path.write_text(DIRECT)
    return path


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["dynamics", *map(str, arguments)])


def answer(*arguments: object) -> dict[str, Any]:
    result = call(*arguments, "--json", "-")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return found


def refusal(*arguments: object) -> str:
    result = call(*arguments, "--json", "-")
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    return str(result.stderr)


def write_csv(path: Path, frequency_hz: Any, values: Any, kind: str = "receptance") -> Path:
    rows = [
        f"{f!r},{v.real!r},{v.imag!r}"
        for f, v in zip(np.array(frequency_hz).tolist(), np.array(values).tolist(), strict=True)
    ]
    path.write_text("\n".join([f"frequency_hz,{kind}_re,{kind}_im", *rows]) + "\n")
    return path


def nose(spindle: Path, *options: object) -> tuple[Any, Any]:
    found = answer("frf", spindle, "--at", "nose", *options)
    return np.array(found["frequency_hz"]), np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])


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


def test_published_inertia_raises_the_frequencies(spindle: Path) -> None:
    correct, published = (answer("modes", spindle, "--rotary", which) for which in ("correct", "published"))
    assert published["modes"][1]["frequency_hz"] > 1.005 * correct["modes"][1]["frequency_hz"]
    assert answer("modes", spindle)["modes"] == correct["modes"]


def test_frequencies_of_a_response(spindle: Path) -> None:
    assert len(nose(spindle)[0]) == 2817
    at, _ = nose(spindle, "--from-hz", 100, "--to-hz", 200, "--points", 11)
    assert at.tolist() == pytest.approx(np.arange(100, 201, 10))
    at, _ = nose(spindle, "--from-hz", 100, "--to-hz", 200, "--df", 0.1)
    assert (len(at), at[-1]) == (1001, pytest.approx(200.0))


def test_peaks_lie_where_the_magnitude_is_largest_and_near_the_modes(spindle: Path) -> None:
    found = answer("frf", spindle)
    values = np.abs(np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"]))
    best = max(found["peaks"], key=lambda peak: peak["magnitude_m_per_n"])
    assert best["magnitude_m_per_n"] == values.max()
    assert best["frequency_hz"] == found["frequency_hz"][int(values.argmax())]
    assert np.all(np.array(found["receptance_im"]) < 0.0)
    first = answer("modes", spindle, "--count", 1)["modes"][0]["frequency_hz"]
    assert min(abs(peak["frequency_hz"] - first) for peak in found["peaks"]) < 0.02 * first


def test_a_written_response_is_a_measurement_for_identification(spindle: Path, tmp_path: Path) -> None:
    path = tmp_path / "frf.csv"
    found = answer("frf", spindle, "--points", 400, "--csv", path)
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table[:, 1].tolist() == found["receptance_re"]
    assert answer("identify", spindle, path, "--fixed", "file")["log_error"] < 1e-6
    assert "a folder that exists" in refusal("frf", spindle, "--csv", tmp_path / "nowhere" / "frf.csv")


def test_holder_and_tool_soften_the_spindle() -> None:
    compliance = {}
    for at in ("nose", "holder", "tool"):
        found = answer("frf", "tool_cold_y", "--at", at, "--points", 800)
        compliance[at] = max(peak["magnitude_m_per_n"] for peak in found["peaks"])
    assert compliance["nose"] < compliance["holder"] < compliance["tool"]
    points = answer("modes", "tool_cold_y", "--count", 1)["modes"][0]["points_mm"]
    assert (points[0], points[-1]) == (pytest.approx(-144.1), pytest.approx(501.1))


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


def test_twelve_parameters_are_found_again_but_not_all_determined(spindle: Path, tmp_path: Path) -> None:
    found = answer("identify", spindle, write_csv(tmp_path / "m.csv", *nose(spindle)), "--parameters", 12)
    assert len(found["values"]) == len(found["identifiable"]) == 12
    assert not all(found["identifiable"].values())
    assert found["evaluations"] < 10


def test_kept_parameters_come_from_the_file_where_only_that_fits(spindle: Path, tmp_path: Path) -> None:
    measured = write_csv(tmp_path / "m.csv", *nose(spindle, "--points", 600))
    found = answer("identify", spindle, measured)
    assert found["fixed_from"] == "file"
    assert found["values"]["kt_34"] == pytest.approx(1.7e8, rel=1e-4)
    assert answer("identify", spindle, measured, "--fixed", "source")["log_error"] > 10 * found["log_error"]


def test_accelerance_and_universal_files_give_the_same(spindle: Path, tmp_path: Path) -> None:
    import pyuff

    at, values = nose(spindle, "--points", 400)
    omega = 2 * np.pi * at
    plain = answer("identify", spindle, write_csv(tmp_path / "r.csv", at, values), "--fixed", "file")
    inertance = write_csv(tmp_path / "a.csv", at, -(omega**2) * values, "accelerance")
    universal = tmp_path / "m.uff"
    at = np.linspace(at[0], at[-1], len(at))
    pyuff.UFF(str(universal)).write_sets(
        [
            {
                "type": 58, "func_type": 4, "rsp_node": 1, "rsp_dir": 2, "ref_node": 1, "ref_dir": 2,
                "x": at, "data": -(omega**2) * values, "id1": "nose", "id2": "", "id3": "", "id4": "", "id5": "",
                "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13,
                "ordinate_axis_units_lab": "m/s^2", "orddenom_axis_units_lab": "N", "binary": 1,
            }
        ],
        mode="add",
    )  # fmt: skip
    for path in (inertance, universal):
        found = answer("identify", spindle, path, "--fixed", "file")
        assert found["values"] == pytest.approx(plain["values"], rel=1e-6), path


def test_contact_of_the_holder_is_found_again(tmp_path: Path) -> None:
    found = answer("frf", "holder_warm_y", "--at", "holder", "--points", 500)
    values = np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])
    measured = write_csv(tmp_path / "h.csv", found["frequency_hz"], values)
    contact = answer("contact", "holder_cold_y", measured, "--joint", "spindle-holder")
    expected = {"kt": 1.25e8, "ct": 3.56e3, "kr": 8.63e5, "cr": 2.35e3}
    assert contact["values"] == pytest.approx(expected, rel=1e-4)


def test_contact_within_the_shaft_is_found_again(tmp_path: Path) -> None:
    jointed = tmp_path / "jointed.yaml"
    joint = (
        "joints: [{after_segment: 2, kt_n_per_m: 6.13e8, ct_ns_per_m: 500, kr_nm_per_rad: 3.07e6, cr_nms_per_rad: 5}]"
    )
    free = FREE
    jointed.write_text(f"{free}{joint}\n")
    measured = write_csv(tmp_path / "m.csv", *nose(jointed, "--points", 600))
    plain = tmp_path / "plain.yaml"
    plain.write_text(free)
    found = answer("contact", plain, measured, "--joint", "shaft", "--after-segment", 2)
    assert found["values"]["kt"] == pytest.approx(6.13e8, rel=1e-3)
    assert found["values"]["kr"] == pytest.approx(3.07e6, rel=1e-3)


def test_sensitivity_of_steel_scales_with_the_root_of_the_moduli(spindle: Path, tmp_path: Path) -> None:
    free = tmp_path / "free.yaml"
    free.write_text(FREE)
    found = answer("sensitivity", free, "--percent", 5)
    both = next(each for each in found["variations"] if each["moduli"] == "E+G" and each["percent"] == 5.0)
    for mode in both["modes"]:
        assert mode["change_percent"] == pytest.approx(100 * (np.sqrt(1.05) - 1), rel=1e-6)
        assert mode["mac"] == pytest.approx(1.0)


def test_sensitivity_varies_only_composites() -> None:
    found = answer("sensitivity", "model_2", "--percent", 5)
    assert found["varied_segments"] == list(range(2, 9))
    assert set(found["varied_materials"]) == {"cfrp_0", "cfrp_pm30", "cfrp_pm45"}
    changes = [m["change_percent"] for each in found["variations"] for m in each["modes"]]
    assert 0.1 < max(np.abs(changes)) < 2.4


def test_comparison_of_layouts(tmp_path: Path) -> None:
    found = answer("compare", "unit_model_5_y", "unit_model_6_y", "--points", 1500)
    first, second = found["layouts"]
    assert first["compliance_change_percent"] == 0.0
    assert second["compliance_m_per_n"] > 1.3 * first["compliance_m_per_n"]
    assert second["frequency_hz"] < first["frequency_hz"]


@pytest.mark.parametrize("ending", ["png", "html"])
def test_pictures(spindle: Path, tmp_path: Path, ending: str) -> None:
    measured = write_csv(tmp_path / "m.csv", *nose(spindle, "--points", 300))
    calls: dict[str, list[object]] = {
        "modes": ["modes", "tool_cold_y", "--count", 2],
        "frf": ["frf", spindle, "--points", 200],
        "identify": ["identify", spindle, measured, "--fixed", "file"],
        "sensitivity": ["sensitivity", "model_2"],
        "compare": ["compare", "unit_model_5_y", spindle, "--points", 200],
    }
    for name, arguments in calls.items():
        path = tmp_path / f"{name}.{ending}"
        answer(*arguments, "--picture", path)
        start = path.read_bytes()[:200]
        assert start.startswith(b"\x89PNG") if ending == "png" else b"<html" in start
        assert path.stat().st_size > 10_000
    assert "a picture ends in" in refusal("modes", spindle, "--picture", tmp_path / "p.gif")


@pytest.mark.parametrize("name", shipped_spindles())
def test_every_shipped_spindle_can_be_computed(name: str) -> None:
    assert all(mode["frequency_hz"] > 300 for mode in answer("modes", name, "--count", 2)["modes"])


BAD_FILES = {
    "zero length": (
        "length_mm: 15.1",
        "length_mm: 0",
        ":3:17: segments[0].length_mm: this must be at least 0.01, not 0",
    ),
    "negative": (
        "length_mm: 15.1",
        "length_mm: -15",
        ":3:17: segments[0].length_mm: this must be at least 0.01, not -15",
    ),
    "inner": ("inner_mm: 42.4", "inner_mm: 89", ":3:39: segments[0].inner_mm: inner 89 mm must be smaller"),
    "ring": ("ring: {outer_mm: 85.0", "ring: {outer_mm: 50", "segments[2].ring.outer_mm: a ring sits on the segment"),
    "outside": ("position_mm: 400.1", "position_mm: 500", ":10:18: bearings[2].position_mm: 500 mm lies outside"),
    "before": ("position_mm: 99.1", "position_mm: -1", "bearings[0].position_mm: this must be at least 0"),
    "group": ("'12'", "'13'", ":8:13: bearings[0].group: this must be one of"),
    "negative stiffness": ("5.11e7", "-5.11e7", ":8:50: bearings[0].kt_n_per_m: this must be at least 0"),
    "stiffness": ("5.11e7", "5.11e77", "bearings[0].kt_n_per_m: this must be at most 1e+15"),
    "pascals": ("E_gpa: 200", "E_gpa: 200e9", ":3:62: segments[0].E_gpa: this must be at most 2000"),
    "unknown key": ("inner_mm: 42.4", "iner_mm: 42.4", "unknown key; did you mean `inner_mm`?"),
    "material": (
        STEEL,
        "material: stel",
        ":3:65: segments[0].material: the material 'stel' is not known; did you mean",
    ),
    "lacking": ("E_gpa: 200, ", "", "segments[0]: E_gpa missing"),
    "nan": ("nu: 0.3", "nu: .nan", "is not a number that can be used"),
    "text": ("length_mm: 15.1", "length_mm: long", "this must be a number, not the text 'long'"),
}


@pytest.mark.parametrize("case", BAD_FILES)
@pytest.mark.parametrize("command", ["modes", "frf", "sensitivity"])
def test_bad_files_are_refused_with_line_and_key(tmp_path: Path, case: str, command: str) -> None:
    old, new, words = BAD_FILES[case]
    path = tmp_path / "bad.yaml"
    path.write_text(DIRECT.replace(old, new, 1))
    said = refusal(command, path)
    assert str(path) in said
    assert words in said


def test_bearings_of_a_group_may_differ_in_a_response_but_not_in_an_identification(
    spindle: Path, tmp_path: Path
) -> None:
    twice = f"  - {{group: '12', position_mm: 120.0, kt_n_per_m: 3e7, ct_ns_per_m: 500, {TURNING}}}\n"
    path = tmp_path / "differ.yaml"
    path.write_text(DIRECT + twice)
    measured = write_csv(tmp_path / "m.csv", *nose(path, "--points", 300))
    said = refusal("identify", path, measured)
    assert "the bearings of group '12' have different properties" in said


def test_missing_parts_are_refused(spindle: Path, tmp_path: Path) -> None:
    assert "describes no holder" in refusal("frf", spindle, "--at", "holder")
    assert "describes no tool" in refusal("frf", spindle, "--at", "tool")
    assert "spindles that ship are" in refusal("modes", tmp_path / "nowhere.yaml")
    assert "describes no bearings" in refusal("identify", "steel", write_csv(tmp_path / "m.csv", *nose(spindle)))
    assert f"{spindle}: the file describes no tool" in refusal("compare", "tool_cold_y", spindle, "--at", "tool")
    assert "--after-segment must name" in refusal(
        "contact", spindle, tmp_path / "m.csv", "--joint", "shaft", "--after-segment", 9
    )
    assert "the first must lie above 0" in refusal("frf", spindle, "--from-hz", 500, "--to-hz", 400)


def test_unfit_measurements_are_refused_with_a_sentence(spindle: Path, tmp_path: Path) -> None:
    at, values = nose(spindle)
    path = tmp_path / "m.csv"
    cases = {
        "um/N": (at, values * 1e6, "is the unit um/N"),
        "accelerance": (at, values * (2 * np.pi * at) ** 2, "is this an accelerance?"),
        "narrow": (at[:40], values[:40], "from 300 to 330.469 Hz is too narrow"),
        "few": (at[:5], values[:5], "5 frequencies cannot determine 5 parameters"),
    }
    for frequency, response, words in cases.values():
        said = refusal("identify", spindle, write_csv(path, frequency, response))
        assert words in said
        assert str(path) in said
    lines = write_csv(path, at, values).read_text().splitlines()
    broken = {
        ":7: column receptance_re: 'nan'": [*lines[:6], "304,nan,0", *lines[7:]],
        ":7: column frequency_hz: 300 Hz does not lie above": [*lines[:6], "300,1e-7,0", *lines[7:]],
        ":7: has 2 fields": [*lines[:6], "304,1e-7", *lines[7:]],
        ":1: there is no column frequency_hz": ["f,re,im", *lines[1:]],
        ":1: has 0 responses": ["frequency_hz,re,im", *lines[1:]],
    }
    for words, content in broken.items():
        path.write_text("\n".join(content))
        assert f"{path}{words}" in refusal("identify", spindle, path)
    assert "no frequency is left" in refusal(
        "identify", spindle, write_csv(path, at, values), "--from-hz", 9000, "--to-hz", 9900
    )


WRONG_UNITS = {
    "mm/N": (1.0, 1e3, "numbers in mm/N"),
    "m/kN": (1.0, 1e-3, "numbers in m/kN"),
    "kHz": (1e-3, 1.0, "is the axis in kHz?"),
    "rad/s": (2 * np.pi, 1.0, "is the axis in rad/s"),
    "1/min": (60.0, 1.0, "is the axis in rad/s or 1/min?"),
}


@pytest.mark.parametrize("case", WRONG_UNITS)
def test_a_response_in_another_unit_is_refused_unless_it_is_trusted(spindle: Path, tmp_path: Path, case: str) -> None:
    scale, factor, words = WRONG_UNITS[case]
    at, values = nose(spindle, "--points", 400)
    path = write_csv(tmp_path / "m.csv", at * scale, values * factor)
    said = refusal("identify", spindle, path)
    assert words in said
    assert str(path) in said
    trusted = call("identify", spindle, path, "--trust-units", "--json", "-")
    assert words not in trusted.stderr
    assert "Traceback" not in trusted.output


def test_a_mobility_named_receptance_is_refused(spindle: Path, tmp_path: Path) -> None:
    at, values = nose(spindle, "--points", 400)
    path = write_csv(tmp_path / "m.csv", at, values * 2j * np.pi * at)
    assert "of a mobility in m/s per N" in refusal("identify", spindle, path)
    named = answer("identify", spindle, write_csv(path, at, values * 2j * np.pi * at, "mobility"), "--fixed", "file")
    assert named["log_error"] < 1e-6


def test_the_unit_of_a_response_at_the_holder_is_found_by_what_fits(tmp_path: Path) -> None:
    found = answer("frf", "holder_warm_y", "--at", "holder", "--points", 300)
    values = np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])
    at = np.array(found["frequency_hz"])
    for scale, factor, words in ((1.0, 1e3, "numbers in mm/N"), (2 * np.pi, 1.0, "numbers over rad/s")):
        measured = write_csv(tmp_path / "h.csv", at * scale, values * factor)
        assert words in refusal("contact", "holder_cold_y", measured, "--joint", "spindle-holder")
    trusted = answer("contact", "holder_cold_y", measured, "--joint", "spindle-holder", "--trust-units")
    assert trusted["log_error"] > 1.0


@pytest.mark.parametrize(
    ("scale", "factor", "words"),
    [
        (1.0, 1e290, "m/N, which nothing has"),
        (1.0, 1e-295, "m/N, which nothing has"),
        (1e290, 1.0, "is no frequency at which a response is measured"),
        (1e-290, 1.0, "is no frequency at which a response is measured"),
        (0.0, 1.0, "above 0 Hz|does not lie above the row before"),
    ],
)
def test_numbers_that_nothing_measures_are_refused_though_trusted(
    spindle: Path, tmp_path: Path, scale: float, factor: float, words: str
) -> None:
    at, values = nose(spindle, "--points", 60)
    path = write_csv(tmp_path / "m.csv", at * scale, values * factor)
    assert re.search(words, refusal("identify", spindle, path, "--trust-units"))


def test_a_response_at_0_hz_alone_is_refused(spindle: Path, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "m.csv", [0.0], [1e-8 + 0j])
    assert f"{path}: holds no frequency above 0 Hz" in refusal("identify", spindle, path)


def test_a_narrow_band_names_what_it_does_not_determine(spindle: Path, tmp_path: Path) -> None:
    at, values = nose(spindle, "--from-hz", 8000, "--to-hz", 9000, "--points", 300)
    found = answer("identify", spindle, write_csv(tmp_path / "m.csv", at, values), "--fixed", "file")
    unseen = [name for name, seen in found["identifiable"].items() if not seen]
    assert unseen
    assert f"from 8000 to 9000 Hz does not determine {', '.join(unseen)}" in found["warnings"][-1]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--to-hz", "1e300"), "a spindle is computed between 0.001 and 1e+06 Hz"),
        (("--to-hz", "1e300", "--points", 5), "a spindle is computed between"),
        (("--from-hz", "1e-300", "--to-hz", "1e-299", "--points", 5), "a spindle is computed between"),
        (("--from-hz", "1e308", "--to-hz", "1.7e308", "--points", 5), "a spindle is computed between"),
        (("--df", "1e-300"), "are more than 1000000 frequencies"),
        (("--df", "1e300"), "leaves one frequency"),
        (("--from-hz", 500, "--to-hz", "500.0000000000001", "--points", 1000), "lie too close"),
        (("--points", 10**9), "is not in the range"),
    ],
)
def test_extreme_frequencies_are_refused_with_a_sentence(
    spindle: Path, options: tuple[object, ...], words: str
) -> None:
    assert words in refusal("frf", spindle, *options)


def test_the_outermost_frequencies_give_numbers(spindle: Path) -> None:
    found = answer("frf", spindle, "--from-hz", "0.001", "--to-hz", "1e6", "--points", 50)
    assert np.isfinite(found["receptance_re"]).all()


def test_fewer_modes_than_asked_for_are_said(spindle: Path) -> None:
    found = answer("modes", spindle, "--count", 100)
    assert len(found["modes"]) < 100
    assert f"{len(found['modes'])} of 100 modes lie below" in found["warnings"][0]


@pytest.mark.parametrize("ending", [".png", ".html"])
def test_a_picture_without_its_library_names_what_to_install(
    spindle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    monkeypatch.setitem(PICTURE_LIBRARIES, ending, "library_that_nobody_installed")
    said = refusal("modes", spindle, "--picture", tmp_path / f"p{ending}")
    assert "this picture needs library_that_nobody_installed: install toolpoint[plots]" in said
