"""What a stranger may give `toolpoint stability`: numbers far off, tiny immersions, slow speeds."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from daemon.cli import main

MODE = {"frequency_hz": 922, "damping_ratio": 0.011, "mass_kg": 0.03993}
CASE: dict[str, Any] = {
    "teeth": 2,
    "diameter_mm": 10,
    "radial_depth_mm": 10,
    "milling": "slot",
    "kt_n_per_m2": 6.0e8,
    "kr_ratio": 1.0 / 3.0,
    "x": {"modes": [MODE]},
    "y": "rigid",
    "feed_deg": 0,
}


@pytest.fixture
def run(tmp_path: Path) -> Any:
    def call(command: str, *arguments: object, **changes: Any) -> Result:
        (tmp_path / "case.yaml").write_text(json.dumps(CASE | changes), encoding="utf-8")
        words = [command, *([str(tmp_path / "case.yaml")] if command == "lobes" else []), *map(str, arguments)]
        result = CliRunner().invoke(main, ["stability", *words, "--json", "-"])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        assert "Traceback" not in result.stderr
        assert "Warning" not in result.stderr
        for word in ("NaN", "Infinity"):
            assert word not in result.stdout
        return result

    return call


EXTREMES = {
    "mass_kg: this must be at most": {"x": {"modes": [MODE | {"mass_kg": 1e300}]}},
    "mass_kg: this must be at least": {"x": {"modes": [MODE | {"mass_kg": 1e-300}]}},
    "frequency_hz: this must be at most": {"x": {"modes": [MODE | {"frequency_hz": 1e300}]}},
    "frequency_hz: this must be at least": {"x": {"modes": [MODE | {"frequency_hz": 1e-300}]}},
    "damping_ratio: this must be at least": {"x": {"modes": [MODE | {"damping_ratio": 1e-300}]}},
    "is no residue of a machine": {
        "x": {"modes": [{"frequency_hz": 922, "damping_ratio": 0.011, "residue": [0, -1e300]}]}
    },
    "residue: this must be at most 2 long": {
        "x": {"modes": [{"frequency_hz": 922, "damping_ratio": 0.011, "residue": [0, -1e-3, 0]}]}
    },
    "kt_n_per_m2: this must be at most": {"kt_n_per_m2": 1e300},
    "kr_ratio: this must be at most": {"kr_ratio": 1e308},
    "diameter_mm: this must be at most": {"diameter_mm": 1e300, "radial_depth_mm": 1e300},
    "give the width that is really cut": {"milling": "up", "radial_depth_mm": 1e-9},
    "feed_deg: this must be at most": {"feed_deg": 1e300},
}


@pytest.mark.parametrize("words", EXTREMES)
def test_numbers_of_no_machine_are_refused_by_key(run: Any, words: str) -> None:
    result = run("lobes", "--method", "sdm", **EXTREMES[words])
    assert result.exit_code == 2
    assert words in result.stderr
    assert "case.yaml:1:" in result.stderr


def test_a_speed_too_slow_for_the_steps_is_refused_and_a_slow_one_is_resolved(run: Any) -> None:
    result = run("lobes", "--method", "sdm", "--at", "10:0.2")
    assert result.exit_code == 2
    assert "vibrates 2766 times from tooth to tooth" in result.stderr
    assert "more than the 400 steps" in run("lobes", "--method", "sdm", "--from-rpm", "10").stderr
    assert "--steps 100 do not follow" in run("lobes", "--method", "sdm", "--at", "400:0.2", "--steps", "100").stderr
    radii = [
        json.loads(run("lobes", "--method", "sdm", "--at", "400:0.4", *steps).stdout)["points"][0]["spectral_radius"]
        for steps in ([], ["--steps", "1200"])
    ]
    assert math.isclose(*radii, abs_tol=1e-3)


@pytest.mark.parametrize(("milling", "kind", "radial_mm"), [("up", -1.0, 1e-3), ("down", 1.0, 0.1)])
def test_a_tiny_immersion_has_its_lobes(run: Any, milling: str, kind: float, radial_mm: float) -> None:
    """The closed form of one degree of freedom, with a_xx integrated here."""
    changes = {"milling": milling, "radial_depth_mm": radial_mm}
    swept = 2.0 * math.asin(math.sqrt(radial_mm / 10.0))
    phi = np.linspace(0.0, swept, 20001) if milling == "up" else np.linspace(math.pi - swept, math.pi, 20001)
    force = (-np.cos(phi) - np.sin(phi) / 3.0) * np.sin(phi)
    a_xx = 2.0 / math.pi * float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(phi)))
    assert np.sign(a_xx) == kind
    stiffness = 0.03993 * (2.0 * math.pi * 922.0) ** 2
    closed_mm = 4e3 * stiffness * 0.011 * (1.0 - kind * 0.011) / (6.0e8 * abs(a_xx))
    range_rpm = ("--from-rpm", "5000", "--to-rpm", "30000")
    zoa = json.loads(run("lobes", "--method", "zoa", *range_rpm, **changes).stdout)
    assert math.isclose(zoa["minimum"]["depth_mm"], closed_mm, rel_tol=1e-4)
    sdm = json.loads(run("lobes", "--method", "sdm", "--points", "60", *range_rpm, **changes).stdout)
    assert 0.3 * closed_mm < sdm["minimum"]["depth_mm"] < 1.05 * closed_mm
