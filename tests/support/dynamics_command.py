"""`toolpoint dynamics` called as a person calls it, and a spindle file to call it with."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner, Result

from daemon.cli import main

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
