"""`toolpoint stability` as people and other programs call it: files in, JSON out, a sentence when refused."""

import json
import math
import wave
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from config.machine.stability_case import load_stability_case
from daemon.cli import main
from daemon.workbench.stability.case_files import RotatingSpindle
from models.stability.response import ModalResponse, mode_from_mass

CASE = """\
teeth: 2
diameter_mm: 10
radial_depth_mm: 10
milling: slot            # up | down | slot
kt_n_per_m2: 6.0e8
kr_ratio: 0.33333333
x: {modes: [{frequency_hz: 922, damping_ratio: 0.011, mass_kg: 0.03993}]}
y: rigid
feed_deg: 0
"""
MODE = "modes: [{frequency_hz: 922, damping_ratio: 0.011, mass_kg: 0.03993}]"
RATE_HZ = 6400


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["stability", *map(str, arguments)])


def answer(*arguments: object) -> dict:
    result = run(*arguments, "--json", "-")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def refusal(*arguments: object) -> str:
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    return result.stderr.strip()


@pytest.fixture
def case(tmp_path: Path) -> Path:
    path = tmp_path / "case.yaml"
    path.write_text(CASE)
    return path


def other(case: Path, *changes: tuple[str, str]) -> Path:
    text = CASE
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = case.with_name("other.yaml")
    path.write_text(text)
    return path


def write_frf(path: Path, lines_hz: np.ndarray) -> None:
    response = ModalResponse(xx=(mode_from_mass(922.0, 0.011, 0.03993),))
    receptance = response.receptance_m_per_n(lines_hz)[:, 0, 0]
    rows = [f"{f!r},{h.real!r},{h.imag!r}" for f, h in zip(lines_hz.tolist(), receptance.tolist(), strict=True)]
    path.write_text("\n".join(["frequency_hz,receptance_re,receptance_im", *rows]) + "\n")


LINES_HZ = np.arange(384, 3201) * 12800 / 16384


def test_lobes_of_the_benchmark(case: Path) -> None:
    found = answer("lobes", case, "--method", "zoa", "--from-rpm", 5000, "--to-rpm", 25000, "--points", 500)
    assert len(found["speed_rpm"]) == len(found["limiting_depth_mm"]) == len(found["chatter_hz"]) == 500
    assert (found["speed_rpm"][0], found["speed_rpm"][-1]) == (5000.0, 25000.0)
    assert found["minimum"]["depth_mm"] == pytest.approx(0.29805, abs=1e-5)
    assert 5000.0 <= found["minimum"]["speed_rpm"] <= 25000.0
    assert min(found["limiting_depth_mm"]) >= found["minimum"]["depth_mm"]


TURNING = """\
teeth: 4
diameter_mm: 10
radial_depth_mm: 5
milling: down
material: al7075_t6
x: {spindle: simulated_machine}
y: {spindle: simulated_machine}
"""


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("turning") / "case.yaml"
    path.write_text(TURNING, encoding="utf-8")
    return path


def test_a_spindle_is_computed_at_each_speed(turning: Path) -> None:
    """The same as an FRF of all four entries, computed at that speed alone."""
    found = answer("lobes", turning, "--from-rpm", 9000, "--to-rpm", 12000, "--points", 2)
    spindle = RotatingSpindle(load_stability_case(turning), 12000.0)
    samples = spindle.at(12000.0)
    for place, name in enumerate(("x", "xy", "yx", "y")):
        entry = samples.receptance[:, place // 2, place % 2]
        rows = np.column_stack((samples.frequency_hz, entry.real, entry.imag)).tolist()
        lines = ["frequency_hz,receptance_re,receptance_im", *(f"{hz!r},{re!r},{im!r}" for hz, re, im in rows)]
        (turning.parent / f"{name}.csv").write_text("\n".join(lines), encoding="utf-8")
    measured = turning.parent / "measured.yaml"
    both = "x: {frf: x.csv}\ny: {frf: y.csv}\nxy: {frf: xy.csv}\nyx: {frf: yx.csv}\n"
    measured.write_text(TURNING.partition("x: {")[0] + both, encoding="utf-8")
    expected = answer("lobes", measured, "--from-rpm", 12000, "--to-rpm", 12012, "--points", 2)
    assert found["limiting_depth_mm"][1] == pytest.approx(expected["limiting_depth_mm"][0], rel=1e-6)
    assert found["speed_rpm"] == [9000.0, 12000.0]
    assert found["minimum"]["depth_mm"] == pytest.approx(min(found["limiting_depth_mm"]))


SMALL = """\
structural_damping: 0.004
segments: [{length_mm: 160, outer_mm: 30, inner_mm: 12, material: steel}]
bearings:
  - {group: front, position_mm: 30, kt_n_per_m: 1.0e8, ct_ns_per_m: 100, kr_nm_per_rad: 1.0e4}
  - {group: rear, position_mm: 145, kt_n_per_m: 6.0e7, ct_ns_per_m: 60}
holder: {segments: [{length_mm: 30, outer_mm: 20, material: holder_steel}]}
tool: {segments: [{length_mm: 15, outer_mm: 3, material: carbide}]}
"""


def test_the_resonance_of_a_small_tool_is_within_what_is_computed(tmp_path: Path) -> None:
    """At 12 kHz its tip yields fifty times as much as below 4 kHz, where the frequencies ended whatever the tool."""
    (tmp_path / "small.yaml").write_text(SMALL)
    both = "{spindle: small.yaml}"
    case = tmp_path / "case.yaml"
    case.write_text(CASE.replace(f"{{{MODE}}}", both).replace("y: rigid", f"y: {both}").replace("10\n", "3\n"))
    found = answer("lobes", case, "--from-rpm", 45000, "--to-rpm", 45100, "--points", 2)
    assert found["chatter_hz"][0] == pytest.approx(12000.0, rel=0.03)
    assert found["limiting_depth_mm"][0] < 0.1
    spindle = RotatingSpindle(load_stability_case(case), 45000.0)
    samples, modes = spindle.at(45000.0), spindle.modes_at(45000.0)
    apart = modes.receptance_m_per_n(samples.frequency_hz) - samples.receptance
    assert np.abs(apart).max() < 0.03 * np.abs(samples.receptance).max(), "as the semi-discretisation takes them"


def test_where_a_spindle_cannot_be_computed(turning: Path) -> None:
    assert "leave out --band for a spindle" in refusal("lobes", turning, "--band", "--points", 2)
    one = turning.parent / "one.yaml"
    one.write_text(TURNING.replace("y: {spindle: simulated_machine}", "y: rigid"), encoding="utf-8")
    assert "a spindle is computed in both axes: give x and y a spindle" in run_config(one)
    published = turning.parent / "published.yaml"
    published.write_text(TURNING.replace("simulated_machine", "tool_cold_y"), encoding="utf-8")
    assert "state `rigid_rotary_inertia: correct`" in refusal("lobes", published, "--points", 2)
    assert "give modes or frf" in refusal(
        "warm-up", turning, "--programmed-rpm", 9000, "--depth-mm", 1, "--dynamics", "case"
    )


def test_steps_count_for_a_spindle_that_turns(turning: Path, case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same modes at every speed, it has the lobes of a case that gives them."""
    modes = ModalResponse(xx=(mode_from_mass(922.0, 0.011, 0.03993),))
    monkeypatch.setattr(RotatingSpindle, "modes_at", lambda *_: modes)
    slot = turning.with_name("slot.yaml")
    both = "{spindle: simulated_machine}"
    slot.write_text(CASE.replace(f"{{{MODE}}}", both).replace("y: rigid", f"y: {both}"), encoding="utf-8")
    words = ("--method", "sdm", "--steps", 12, "--from-rpm", 9000, "--to-rpm", 11000, "--points", 2)
    found, expected = answer("lobes", slot, *words), answer("lobes", case, *words)
    assert found["limiting_depth_mm"] == pytest.approx(expected["limiting_depth_mm"], rel=1e-6)
    at = f"9000:{1.001 * found['limiting_depth_mm'][0]}"
    under = f"9000:{0.999 * found['limiting_depth_mm'][0]}"
    points = answer("lobes", slot, "--method", "sdm", "--steps", 12, "--at", at, "--at", under)["points"]
    assert [each["stable"] for each in points] == [False, True]


def run_config(path: Path) -> str:
    result = run("lobes", path)
    assert result.exit_code != 0
    return result.stderr


def test_semi_discretised_lobes_and_their_picture(case: Path) -> None:
    picture = case.with_name("lobes.png")
    arguments = ("--from-rpm", 8000, "--to-rpm", 12000, "--points", 9, "--picture", picture)
    found = answer("lobes", case, "--method", "sdm", *arguments)
    assert found["minimum"]["depth_mm"] == pytest.approx(0.316, abs=0.003)
    assert found["minimum"]["depth_mm"] <= min(found["limiting_depth_mm"])
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_the_worst_feed_direction(case: Path) -> None:
    path = other(
        case, ("feed_deg: 0", "feed_deg: all"), ("milling: slot", "milling: down"), ("_mm: 10\nmill", "_mm: 2\nmill")
    )
    worst = answer("lobes", path)
    along_x = answer("lobes", other(case, ("milling: slot", "milling: down"), ("_mm: 10\nmill", "_mm: 2\nmill")))
    assert worst["minimum"]["depth_mm"] < along_x["minimum"]["depth_mm"]


@pytest.mark.parametrize("method", [("--method", "zoa"), ("--method", "sdm", "--steps", 12)])
def test_the_worst_feed_direction_counts_at_each_speed(case: Path, method: tuple[object, ...]) -> None:
    across = (("y: rigid", "y: {modes: [{frequency_hz: 700, damping_ratio: 0.02, mass_kg: 0.1}]}"),)
    down = (("milling: slot", "milling: down"), ("_mm: 10\nmill", "_mm: 2\nmill"))
    words = (*method, "--from-rpm", 9000, "--to-rpm", 12000, "--points", 2)
    worst = answer("lobes", other(case, *across, *down, ("feed_deg: 0", "feed_deg: all")), *words)
    each = [
        answer("lobes", other(case, *across, *down, ("feed_deg: 0", f"feed_deg: {feed}")), *words)["limiting_depth_mm"]
        for feed in np.arange(0.0, 180.0, 22.5)
    ]
    assert worst["limiting_depth_mm"] == pytest.approx(np.min(each, axis=0), rel=1e-9)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("mass_kg", "mas_kg"), "other.yaml:7:55: x.modes[0].mas_kg: unknown key"),
        (("y: rigid", "y: rigit"), "other.yaml:8:4: y: this must be one of 'rigid'"),
        (
            ("radial_depth_mm: 10", "radial_depth_mm: 11"),
            "radial_depth_mm: the radial depth 11 mm is outside 0 to 10 mm",
        ),
        (("radial_depth_mm: 10", "radial_depth_mm: 5"), "a slot is as wide as the tool"),
        ((f"x: {{{MODE}}}", "x: rigid"), "both rigid"),
        (("kr_ratio: 0.33333333\n", ""), "give kt_n_per_m2 and kr_ratio"),
        (("damping_ratio: 0.011", "damping_ratio: 1.5"), "damping_ratio: this must be below 1"),
        ((", mass_kg: 0.03993", ""), "give one of mass_kg, stiffness_n_per_m and residue, not none"),
        (("teeth: 2", "teeth: 2.5"), "teeth: this must be a whole number"),
        (("feed_deg: 0", "feed_deg: any"), "feed_deg: this must be one of 'all'"),
    ],
)
def test_a_wrong_case_is_refused_with_its_place(case: Path, change: tuple[str, str], sentence: str) -> None:
    assert sentence in refusal("lobes", other(case, change))


def test_an_frf_in_another_unit_is_refused(case: Path) -> None:
    path = other(case, (f"{{{MODE}}}", "{frf: x.csv}"))
    frf = case.with_name("x.csv")
    write_frf(frf, LINES_HZ)
    rows = frf.read_text().splitlines()
    scaled = [f"{a},{1e6 * float(b)!r},{1e6 * float(c)!r}" for a, b, c in (row.split(",") for row in rows[1:])]
    frf.write_text("\n".join([rows[0], *scaled]) + "\n")
    assert "softer than any tool; is the unit um/N" in refusal("lobes", path)
    too_light = [f"{a},{200 * float(b)!r},{200 * float(c)!r}" for a, b, c in (row.split(",") for row in rows[1:])]
    frf.write_text("\n".join([rows[0], *too_light]) + "\n")
    said = refusal("lobes", path)
    assert f"{frf}: read in m/N, a mass of 0.2 g moves with the tool point" in said
    assert "is the unit mm/N" in said
    trusted = other(case, (f"{{{MODE}}}", "{frf: x.csv, trust_units: true}"))
    assert answer("lobes", trusted)["minimum"]["depth_mm"] == pytest.approx(0.29805 / 200, rel=1e-3)
    path = other(case, (f"{{{MODE}}}", "{frf: x.csv}"))
    frf.write_text("\n".join([*rows[:4], "nonsense,1,2"]) + "\n")
    assert "x.csv:5: column frequency_hz: 'nonsense' is no finite number" in refusal("lobes", path)
    frf.write_text("\n".join(rows[:3]) + "\n")
    assert "holds 2 frequencies" in refusal("lobes", path)
    frf.write_text("\n".join([rows[0], *rows[1::300]]) + "\n")
    sampled = refusal("lobes", path, "--method", "sdm")
    assert f"{frf}: an FRF of 10 frequencies is too short for a modal fit" in sampled, "a case has up to four files"


def test_lobes_over_temperature_with_the_commanded_speed(case: Path) -> None:
    warm = other(case, ("frequency_hz: 922", "frequency_hz: 990"))
    picture = case.with_name("lobes.html")
    arguments = ("--programmed-rpm", 10000, "--depth-mm", 1.0, "--picture", picture)
    first, second = answer("compare", case, warm, *arguments)["cases"]
    assert second["speed_rpm"] != first["speed_rpm"]
    text = picture.read_text("utf-8")
    assert "commanded, case" in text and "working point, case" in text and "tozeroy" in text
    assert "<script src=" not in text
    assert "belong together" in refusal("compare", case, "--depth-mm", 1.0)


def test_the_speed_of_the_published_rule() -> None:
    found = answer("speed", "--resonance-hz", 664.0, "--offset-hz", 24.0, "--teeth", 4, "--lobe", 2)
    assert found["speed_rpm"] == pytest.approx(4800.0), "60 x 640 / (4 x 2)"
    above = answer("speed", "--resonance-hz", 600.0, "--offset-hz", -20.0, "--teeth", 2)
    assert above["speed_rpm"] == pytest.approx(18600.0)
    assert "4800" in run("speed", "--resonance-hz", 664.0, "--offset-hz", 24.0, "--teeth", 4, "--lobe", 2).stderr


def test_the_modes_of_a_response_are_those_that_it_was_made_of(case: Path) -> None:
    write_frf(case.with_name("tip.csv"), LINES_HZ)
    measured = other(case, (MODE, "frf: tip.csv"))
    found = answer("modes", measured)
    assert set(found) == {"x"} and found["x"]["relative_residual"] < 1e-3
    (mode,) = found["x"]["modes"]
    assert mode["frequency_hz"] == pytest.approx(922.0, rel=1e-4)
    assert mode["damping_ratio"] == pytest.approx(0.011, rel=1e-2)
    assert "x: 922.0 Hz, damping ratio 0.0110" in (said := run("modes", measured).stderr)
    assert f"x: residual {found['x']['relative_residual']:.2%} of the response" in said
    assert "no direction of this case names an FRF" in refusal("modes", case)


def test_a_choice_is_told_as_one_pair_of_speed_and_feed(case: Path) -> None:
    asked = ("--programmed-rpm", 10000, "--depth-mm", 0.1, "--feed-mm-min", 1400)
    told = run("choose", case, *asked, "--json", "-")
    chosen = json.loads(told.stdout)
    assert f"S{chosen['speed_rpm']:.0f} F{chosen['feed_mm_min']:.0f}: limiting depth" in told.stderr
    assert chosen["feed_mm_min"] == pytest.approx(1400 * chosen["speed_rpm"] / 10000)


def test_a_choice_by_the_zeroth_order_is_no_flip_chatter(tmp_path: Path) -> None:
    """It said S20500, limiting depth 7.99 mm, where the vibration grows by a tenth from tooth to tooth."""
    modes = "modes: [{{frequency_hz: {}, damping_ratio: 0.01, stiffness_n_per_m: 6.0e6}}]"
    (path := tmp_path / "low.yaml").write_text(
        "teeth: 4\ndiameter_mm: 10\nradial_depth_mm: 0.5\nmilling: down\nkt_n_per_m2: 8.0e8\nkr_ratio: 0.3\n"
        f"x: {{{modes.format(600)}}}\ny: {{{modes.format(660)}}}\nfeed_deg: 0\n"
    )
    asked = ("--depth-mm", 4, "--programmed-rpm", 20500, "--max-rpm", 24000)
    found = answer("choose", path, *asked)
    at = [f"{share * found['speed_rpm']}:4" for share in (0.99, 1.0, 1.01)]
    points = answer("lobes", path, "--method", "sdm", *(word for each in at for word in ("--at", each)))["points"]
    assert all(each["stable"] for each in points)
    compared = answer("compare", path, *asked[:4], "--from-rpm", 16400, "--to-rpm", 24000)
    assert compared["cases"][0]["speed_rpm"] == pytest.approx(found["speed_rpm"], rel=0.02)


def test_coefficients_from_mean_forces(case: Path) -> None:
    feeds = np.array([0.05, 0.1, 0.15, 0.2])
    depth_m, turns = 2e-3, 2 / (2.0 * math.pi)
    square, product, cosine, sine = math.pi / 2.0, 0.0, 0.0, 2.0
    tangential, radial, edge_t, edge_r = 6e8, 2e8, 15e3, 12e3
    feed_m = feeds * 1e-3
    force_x = turns * depth_m * (feed_m * (-tangential * product - radial * square) - edge_t * cosine - edge_r * sine)
    force_y = turns * depth_m * (feed_m * (tangential * square - radial * product) + edge_t * sine - edge_r * cosine)
    path = case.with_name("forces.csv")
    rows = [f"{f},{x},{y}" for f, x, y in zip(feeds, force_x, force_y, strict=True)]
    path.write_text("\n".join(["feed_per_tooth_mm,mean_force_x_n,mean_force_y_n", *rows]) + "\n")
    found = answer("coefficients", path, "--case", case, "--depth-mm", 2.0)
    assert found["kt_n_per_m2"] == pytest.approx(6e8)
    assert found["kr_ratio"] == pytest.approx(1.0 / 3.0)
    assert found["tangential_edge_n_per_m"] == pytest.approx(15e3)
    rows_of_excel = path.read_text().replace(",", ";").replace(".", ",")
    path.with_name("excel.csv").write_text(rows_of_excel.replace("feed", "Feed"))
    other = answer("coefficients", path.with_name("excel.csv"), "--case", case, "--depth-mm", 2.0)
    assert other["kt_n_per_m2"] == found["kt_n_per_m2"]
    path.write_text(path.read_text().replace(rows[1], "0.1,x,3"))
    assert "forces.csv:3: a field is no number" in refusal("coefficients", path, "--case", case, "--depth-mm", 2.0)
    path.write_text(path.read_text().replace("\n0.1,x", "\n\n\n0.1,x"))
    assert "forces.csv:5: a field is no number" in refusal("coefficients", path, "--case", case, "--depth-mm", 2.0)
    assert "needs --case" in refusal("coefficients", path)


def cut(seconds: float, chatter: float) -> np.ndarray:
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    signal = np.random.default_rng(3).normal(size=len(time_s)) * 0.2
    for order in (1, 2, 3):
        signal += np.sin(2.0 * np.pi * order * 400.0 * time_s) / order
    return signal + chatter * np.sin(2.0 * np.pi * 609.0 * time_s)


def write_csv(path: Path, signal: np.ndarray, rate_hz: float = RATE_HZ) -> Path:
    rows = [f"{i / rate_hz:.8f},{value:.6f}" for i, value in enumerate(signal)]
    path.write_text("\n".join(["time_s,acceleration_m_s2", *rows]) + "\n")
    return path


def write_wav(path: Path, signal: np.ndarray) -> Path:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE_HZ)
        file.writeframes(np.clip(signal * 6000.0, -32768, 32767).astype("<i2").tobytes())
    return path


@pytest.mark.parametrize("write", [write_csv, write_wav])
def test_chatter_in_a_recording(tmp_path: Path, write: object) -> None:
    for level, expected in ((0.0, False), (2.0, True)):
        path = write(tmp_path / f"cut.{'csv' if write is write_csv else 'wav'}", cut(3.0, level))
        found = answer("chatter", path, "--speed-rpm", 6000, "--teeth", 4)
        assert found["chatter"] is expected
        assert found["frequency_hz"] == (pytest.approx(609.0, abs=0.5) if expected else None)
        assert found["tooth_passing_hz"] == pytest.approx(400.0, abs=0.5)


def test_teeth_that_may_pass_beyond_a_recording_are_refused(tmp_path: Path) -> None:
    """To within 3 %, as the speed is known; 3150 Hz of 3200 were no refusal but a defect."""
    path = write_csv(tmp_path / "cut.csv", cut(1.0, 0.0))
    for speed_rpm in (47250, 48000):
        assert "reaches 3200 Hz; check speed and teeth" in refusal(
            "chatter", path, "--speed-rpm", speed_rpm, "--teeth", 4
        )


def test_the_picture_of_a_recording_is_called_after_it(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "cut 7.csv", cut(2.0, 2.0))
    answer("chatter", path, "--speed-rpm", 6000, "--teeth", 4, "--picture", tmp_path / "cut.html")
    assert "<title>cut 7.csv</title>" in (tmp_path / "cut.html").read_text("utf-8")


def test_roughness_of_a_profile_and_its_picture(tmp_path: Path) -> None:
    """Two sines, at 4 and 6 mm deep: Ra of a sine is 2 / pi of its height."""
    path, picture = tmp_path / "wall.csv", tmp_path / "wall.html"
    position = np.arange(4000) * 0.001
    rows = [
        f"{at:.3f},{height * math.sin(2.0 * math.pi * at / 0.1):.5f},{depth}"
        for depth, height in ((4, 1.0), (6, 5.0))
        for at in position
    ]
    path.write_text("\n".join(["position_mm,height_um,depth_mm", *rows]) + "\n")
    found = answer("roughness", path, "--picture", picture)["depths"]
    assert [each["depth_mm"] for each in found] == [4.0, 6.0]
    assert [each["ra_um"] for each in found] == pytest.approx([2.0 / math.pi, 10.0 / math.pi], rel=0.01)
    text = picture.read_text("utf-8")
    assert "<title>wall.csv</title>" in text and "4 mm" in text and "6 mm" in text
    assert run("roughness", path).stderr.splitlines()[0].startswith("4 mm: Ra 0.63")
    path.write_text(path.read_text().replace("0.002,", "0.002x,", 1))
    assert f"{path}:4:" in refusal("roughness", path)
    path.write_text(path.read_text().replace("\n", "\n\n", 1))
    assert f"{path}:5:" in refusal("roughness", path)
    path.write_text("position_mm,height_um\n" + "\n".join(f"{0.1 * k:.1f},{1e308 * (-1) ** k}" for k in range(50)))
    assert f"{path}:2:" in refusal("roughness", path, "--picture", picture)
    path.write_text("position_mm,height_um\n" + "\n".join(f"{0.1 * k:.1f},1.0" for k in range(5)))
    assert refusal("roughness", path).startswith(str(path))


def test_what_the_machine_has_without_the_cut_is_no_chatter(tmp_path: Path) -> None:
    """609 Hz at the same power in every recording: a gear mesh, as far as anybody can tell."""
    arguments = ("--speed-rpm", 6100, "--teeth", 4)
    cut_path = write_csv(tmp_path / "cut.csv", cut(2.0, 1.0))
    assert answer("chatter", cut_path, *arguments)["chatter"]
    idle_path = write_csv(tmp_path / "idle.csv", cut(2.0, 1.0) - 0.9 * cut(2.0, 0.0))
    found = answer("chatter", cut_path, *arguments, "--idle", idle_path)
    assert not found["chatter"]
    (warning,) = found["warnings"]
    assert "shows 6000 1/min, -1.6 % from the given 6100 1/min" in warning
    louder = write_csv(tmp_path / "louder.csv", cut(2.0, 3.0))
    assert answer("chatter", louder, *arguments, "--idle", idle_path)["chatter"]
    depths = write_csv(tmp_path / "depths.csv", np.concatenate((cut(2.0, 1.0), cut(2.0, 1.0))))
    assert not answer("chatter", depths, *arguments, "--passage=0:2:4", "--passage=2:4:6")["chatter"]
    assert answer("chatter", depths, *arguments, "--passage=0:2:4", "--passage=2:4:4.5")["chatter"]
    other_rate = write_csv(tmp_path / "other.csv", cut(2.0, 1.0), 2 * RATE_HZ)
    assert "record both alike" in refusal("chatter", cut_path, *arguments, "--idle", other_rate)


def test_a_band_lies_around_the_lobes(case, tmp_path):
    words = ["lobes", case, "--method", "zoa", "--points", 12, "--from-rpm", 6000, "--to-rpm", 20000, "--band"]
    found = answer(*words, "--picture", tmp_path / "band.html")
    low, high, expected = (np.array(found[key]) for key in ("depth_low_mm", "depth_high_mm", "limiting_depth_mm"))
    assert np.all(low <= expected) and np.all(expected <= high) and low.min() < 0.9 * expected.min()
    assert "careful" in (tmp_path / "band.html").read_text("utf-8")
    sure = other(
        case, ("feed_deg: 0\n", "feed_deg: 0\nuncertainty: {coefficients: 0, frequency: 0, damping: 0, gain: 0}\n")
    )
    found = answer("lobes", sure, *words[2:])
    assert found["depth_low_mm"] == pytest.approx(found["limiting_depth_mm"], rel=1e-9)
    shallow = run(*words, "--method", "sdm", "--max-depth-mm", 0.05, "--points", 2)
    assert "are known: stable everywhere up to 0.05 mm" in shallow.stderr, "not up to inf mm"
