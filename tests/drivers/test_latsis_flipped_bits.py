"""What one flipped bit in a frame does, over every bit: the residual error rate that the docs state."""

import re
from pathlib import Path

import numpy as np
import pytest
from latsis_line import Line

from models.cleanse import CleansingRules, cleanse_cycle, initial_state
from models.quality import Quality
from models.units import TMP102_DEGC_PER_LSB

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "latsis-frames.md"
SENSORS = 3
CODES = (0x140, 0x15B, 0x17F, 0x190, 0x1A4, 0x1C8, 0x1FF, 0x233)
"""20 to 35 degC."""


def shares(profile: str) -> tuple[float, float, float]:
    """Return of all flips of one bit the shares [%]: plausible but wrong, believed, and believed by more than 1 K."""
    flips = plausible = believed = far = 0
    rules, everyone = CleansingRules(), np.arange(SENSORS)
    for code in CODES:
        degc = code * TMP102_DEGC_PER_LSB
        state = initial_state(SENSORS, np.full(SENSORS, degc), np.zeros(SENSORS))
        for bit in range(8 * len(Line(SENSORS, profile=profile).frame(2, code))):
            line = Line(SENSORS, profile=profile)
            line.codes = dict.fromkeys(line.codes, code)
            line.one_pass()
            frames = [bytearray(line.frame(i, code)) for i in line.ids]
            frames[1][bit // 8] ^= 1 << (bit % 8)
            cycles = line.send(*map(bytes, frames)) + line.rest()
            flips += 1
            cycle = cycles[0]
            good = cycle.quality == Quality.GOOD
            off_k = np.where(good, np.abs(cycle.degc - degc), 0.0)
            plausible += bool(off_k.any())
            found = cleanse_cycle(rules, state, everyone, cycle.degc, cycle.quality, cycle.reason, 10.0, 10.0)
            off_k = np.where(found.quality == Quality.GOOD, np.abs(found.degc - degc), 0.0)
            believed += bool(off_k.any())
            far += bool((off_k > rules.noise_degc).any())
    return 100.0 * plausible / flips, 100.0 * believed / flips, 100.0 * far / flips


@pytest.mark.parametrize("profile", ["bare", "checked"])
def test_the_shares_of_flipped_bits_are_those_that_the_page_states(profile: str) -> None:
    plausible, believed, far = shares(profile)
    assert far == 0.0, "one frame alone never moves a temperature by more than the noise"
    row = re.search(rf"^\| `{profile}` \| ([\d.]+) % \| ([\d.]+) % \| 0 \|$", PAGE.read_text(), re.MULTILINE)
    assert row is not None, f"{profile}: {plausible:.1f} {believed:.1f}"
    assert [float(part) for part in row.groups()] == [round(plausible, 1), round(believed, 1)]
