"""Do no harm: displacements and probes tell whether the estimate helps, and the output heeds them."""

import numpy as np
import pytest
from control_rig import Bench, running

from config.schema.displacements import DisplacementsConfig
from daemon.compensation.skill_monitor import LEAST_PAIRS, MOST_PAIRS, SkillRecord, does_harm, with_measurement
from daemon.history.reader import HistoryReader
from models.records import DisplacementSample

CHANNELS = ("Z1", "other")


def record(pairs):
    made = SkillRecord()
    for measured, estimated in pairs:
        made = with_measurement(made, measured, estimated)
    return made


@pytest.mark.parametrize(
    ("pairs", "harm"),
    [
        ([(20.0, 18.0)] * LEAST_PAIRS, False),
        ([(20.0, -20.0)] * LEAST_PAIRS, True),
        ([(20.0, -20.0)] * (LEAST_PAIRS - 1), False),
        ([(1.0, -2.0)] * MOST_PAIRS, False),
        ([(20.0, -3.0)] * MOST_PAIRS, False),
        ([(20.0, -6.0)] * MOST_PAIRS, True),
        ([(np.nan, -20.0)] * MOST_PAIRS, False),
        ([(20.0, -20.0)] * MOST_PAIRS + [(20.0, 20.0)] * MOST_PAIRS, False),
    ],
    ids=["helps", "doubles", "too few", "both small", "within the margin", "harms", "nothing known", "long ago"],
)
def test_the_verdict(pairs, harm):
    assert does_harm(record(pairs), 5.0) is harm


@pytest.fixture
async def rig(tmp_path):
    bench = Bench(tmp_path)
    displacements = DisplacementsConfig.model_validate(
        {
            "file": {"path": tmp_path / "displacement.csv"},
            "channels": [{"name": name, "column": k + 2} for k, name in enumerate(CHANNELS)],
        }
    )
    bench.configuration = bench.configuration.model_copy(update={"displacements": displacements})
    async with running(bench.rig()) as rig:
        yield rig


def row(rig, z_um, ago_s=0.0):
    """A reading of a sensor that sees the tool point: the true error and what the NC applies."""
    um = np.array([z_um + rig.applied["z"], np.nan])
    utc_s = rig.clock.now().utc_s - ago_s
    return DisplacementSample(utc_s=utc_s, um=um, reason=np.zeros(2, dtype=np.uint8), source="test:1")


async def follow_true_error(rig, true_um, estimated_um, turns):
    for k in range(turns):
        share = min(k / 20.0, 1.0)
        await rig.turn(rig.estimate(0.0, share * estimated_um))
        rig.control.deliver(row(rig, share * true_um))


async def test_an_estimate_of_the_wrong_sign_is_followed_no_longer(rig):
    await rig.active()
    await follow_true_error(rig, -12.0, 12.0, 60)
    assert rig.state == "HOLD"
    assert "axis z" in rig.control.memory.reason and "without it" in rig.control.memory.reason


async def test_an_estimate_that_helps_is_followed_although_the_sensors_see_the_compensation(rig):
    await rig.active()
    await follow_true_error(rig, -12.0, -11.0, 80)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(11.0, abs=0.11)


@pytest.mark.parametrize("ago_s", [7200.0, -7200.0])
async def test_rows_of_another_time_say_nothing_of_the_present(rig, ago_s):
    """Of a share that was away for hours, or of a logger whose clock is wrong: they were compared with the present."""
    await rig.active()
    for k in range(60):
        await rig.turn(rig.estimate(0.0, -12.0 * min(k / 20.0, 1.0)))
        rig.control.deliver(row(rig, 12.0 * min(k / 20.0, 1.0), ago_s))
    await rig.follow(0.0, -12.0, 3)
    assert rig.state == "ACTIVE" and not rig.control.skill._records
    await rig.history.flushed()
    with HistoryReader(rig.configuration.history.path) as reader:
        told = [event.text for event in reader.events(0.0, 1e11) if "apart from the estimate" in event.text]
    assert len(told) == 1 and f"displacements {-ago_s:.0f} s" in told[0]


async def test_a_new_reference_begins_anew(rig):
    await rig.active()
    await follow_true_error(rig, -12.0, 12.0, 60)
    assert rig.state == "HOLD"
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 3)
    rig.control.deliver(row(rig, -12.0))
    await rig.follow(0.0, 0.0, 3)
    assert rig.state == "ACTIVE"
