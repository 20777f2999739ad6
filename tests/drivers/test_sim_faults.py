"""Fault scripts: what they say, and how their mistakes are told."""

from pathlib import Path

import pytest

from drivers.sim.faults import Fault, FaultKind, FaultScriptError, load_faults, parse_faults

SCRIPT = """\
- {kind: noise, at_s: 600, duration_s: 60, target: spindle, amount: 0.02}
- kind: drifting_sensor   # no end
  at_s: 900.5
  target: 17
  amount: -1
- {kind: frozen_cnc, at_s: 0, duration_s: 30}
- {kind: csv_truncated, at_s: 5}
"""


def test_a_script_becomes_frozen_records(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(SCRIPT)
    assert load_faults(path) == (
        Fault(kind=FaultKind.NOISE, at_s=600.0, duration_s=60.0, target="spindle", amount=0.02),
        Fault(kind=FaultKind.DRIFTING_SENSOR, at_s=900.5, target=17, amount=-1.0),
        Fault(kind=FaultKind.FROZEN_CNC, at_s=0.0, duration_s=30.0),
        Fault(kind=FaultKind.CSV_TRUNCATED, at_s=5.0, amount=0.0),
    )
    assert parse_faults("") == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- {kind: nois, at_s: 1, target: a}", r"f:1:4: kind is 'nois', not one of noise, lost_bytes"),
        ("- {at_s: 1}", r"f:1:3: kind is None"),
        ("- {kind: unplugged, target: a}", r"f:1:3: at_s must be a number, not None"),
        ("- {kind: unplugged, target: a, at_s: soon}", r"f:1:32: at_s must be a number, not 'soon'"),
        ("- {kind: unplugged, target: a, at_s: -1}", r"at_s is -1, outside 0\.\.inf"),
        ("- {kind: unplugged, target: a, at_s: .nan}", r"at_s must be a number, not nan"),
        ("- {kind: unplugged, target: a, at_s: true}", r"at_s must be a number, not True"),
        ("- {kind: unplugged, at_s: 1}", r"target of unplugged must name a line, got None"),
        ("- {kind: unplugged, at_s: 1, target: 4}", r"target of unplugged must name a line, got 4"),
        ("- {kind: stuck_sensor, at_s: 1, target: four}", r"must be the ID of a sensor, got 'four'"),
        ("- {kind: reset_burst, at_s: 1}", r"must name a line or be the ID of a sensor"),
        ("- {kind: killed_cnc, at_s: 1, target: a}", r"f:1:31: target of killed_cnc must not be given"),
        ("- {kind: noise, at_s: 1, target: a, amount: 2}", r"amount \(share of bytes\) is 2, outside"),
        ("- {kind: drifting_sensor, at_s: 1, target: 1}", r"needs an amount: drift \[degC/h\]"),
        ("- {kind: dead_line, at_s: 1, target: a, amount: 1.5}", r"must be a whole number, not 1\.5"),
        ("- {kind: unplugged, at_s: 1, target: a, amount: 1}", r"unplugged has no amount"),
        ("- {kind: unplugged, at_s: 1, target: a, duration_s: 0}", r"duration_s must be positive"),
        ("- {kind: csv_rotated, at_s: 1, duration_s: 5}", r"happens at one moment and has no duration_s"),
        ("- {kind: csv_half_row, at_s: 1}", r"csv_half_row needs duration_s"),
        ("- kind: noise\n  at: 1", r"f:2:3: unknown key 'at'; known are amount, at_s, duration_s, kind, target"),
        ("- {kind: noise, kind: noise}", r"kind is given twice"),
        ("- noise", r"f:1:3: a fault is a mapping"),
        ("kind: noise", r"f:1:1: a fault script is a list"),
        ("- [", r"f: not YAML"),
    ],
)
def test_mistakes_are_told_with_their_place(text: str, message: str) -> None:
    with pytest.raises(FaultScriptError, match=message):
        parse_faults(text, "f")
