"""The verification of a chosen speed, where the zeroth order draws too steep a flank: every doubt denies."""

import math
from dataclasses import replace

import numpy as np
import pytest

from models.spindle_speed.choice import SpeedDemand
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.verification import StabilityVerification
from models.stability.collocation import radius_bounds
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, SampledResponse, ToolPointResponse, mode_from_stiffness
from models.stability.semi_discretisation import semi_discretisation, spectral_radius
from models.stability.state_space import state_space

START_RAD, EXIT_RAD = engagement_rad(MillingMode.DOWN, 8.0, 16.0)
CUT = Cut(teeth=4, start_rad=START_RAD, exit_rad=EXIT_RAD, tangential_n_per_m2=8e8, radial_ratio=0.3)
MODES = ModalResponse(
    xx=(mode_from_stiffness(605.0, 0.0125, 1.7e7), mode_from_stiffness(1340.0, 0.015, 5.0e7)),
    yy=(mode_from_stiffness(646.0, 0.013, 1.9e7), mode_from_stiffness(1390.0, 0.016, 5.0e7)),
)
FREQUENCY_HZ = np.arange(300.0, 2500.0, 2.0)
SAMPLED = SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=MODES.receptance_m_per_n(FREQUENCY_HZ))


def radius(speed_rpm: float, depth_mm: float) -> float:
    method = semi_discretisation(state_space(MODES, 0.0), CUT, 80)
    return float(spectral_radius(method, speed_rpm, np.array([depth_mm]))[0])


def decays(speed_rpm: float, depth_mm: float, at_least_per_s: float) -> bool:
    return -math.log(radius(speed_rpm, depth_mm)) * CUT.teeth * speed_rpm / 60.0 >= at_least_per_s


def test_it_says_what_the_spectral_radius_says() -> None:
    check = StabilityVerification(CUT, (0.0,), least_decay_per_s=5.0)
    said = []
    for speed_rpm in np.linspace(6050.0, 10050.0, 25).tolist():
        stable = decays(speed_rpm, 5.0, 5.0)
        assert check.is_stable(MODES, speed_rpm, 5.0, 0.0) is stable
        said.append(stable)
    assert True in said
    assert False in said


def test_a_stable_cut_of_a_lightly_damped_spindle_is_not_denied() -> None:
    """The radius at a millionth of a millimetre is 0.9906 per tooth passing: that is the free decay."""
    light = ModalResponse(xx=(mode_from_stiffness(600.0, 0.005, 2e7),))
    cut = replace(CUT, teeth=6)
    _, upper = radius_bounds(light, cut, feeds_deg=[0.0], speeds_rpm=[20_000.0], depth_mm=1e-6)
    assert upper[0, 0] == pytest.approx(0.9906, abs=1e-3)
    assert StabilityVerification(cut).denial(light, 20_000.0, 1e-6, 0.02) == ""
    heavy = ModalResponse(xx=(mode_from_stiffness(80.0, 0.003, 2e7),))
    assert StabilityVerification(cut).denial(heavy, 20_000.0, 1e-6, 0.02) == ""
    assert "does not die away" in StabilityVerification(cut).denial(light, 20_000.0, 3.0, 0.02)


def test_an_frf_is_verified_by_the_modes_that_follow_it() -> None:
    check = StabilityVerification(CUT)
    said = [check.is_stable(SAMPLED, speed_rpm, 5.0, 0.01) for speed_rpm in (6200.0, 7000.0, 8500.0, 9300.0)]
    assert said == [
        StabilityVerification(CUT).is_stable(MODES, each, 5.0, 0.01) for each in (6200.0, 7000.0, 8500.0, 9300.0)
    ]
    assert said == [False, False, True, True]


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_fit_brings_no_modes_of_its_own_into_the_verdict(noise: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shaken = 1.0 + noise * (rng.normal(size=SAMPLED.receptance.shape) + 1j * rng.normal(size=SAMPLED.receptance.shape))
    response = SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=SAMPLED.receptance * shaken)
    modes = StabilityVerification(CUT).modes(response)
    assert (len(modes.xx), len(modes.yy)) == (2, 2)
    for speed_rpm, depth_mm in ((7000.0, 2.0), (8500.0, 2.0), (8500.0, 5.0), (9300.0, 5.0)):
        _, upper = radius_bounds(modes, CUT, feeds_deg=[0.0], speeds_rpm=[speed_rpm], depth_mm=depth_mm)
        assert upper[0, 0] == pytest.approx(radius(speed_rpm, depth_mm), abs=2e-3)


def test_a_response_that_has_changed_a_little_is_followed_from_the_modes_before() -> None:
    check, moved = StabilityVerification(CUT), SAMPLED
    for warmer in np.linspace(1.0, 1.1, 21).tolist():
        modes = ModalResponse(
            xx=tuple(replace(mode, frequency_hz=warmer * mode.frequency_hz) for mode in MODES.xx),
            yy=tuple(replace(mode, frequency_hz=mode.frequency_hz / warmer) for mode in MODES.yy),
        )
        moved = SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=modes.receptance_m_per_n(FREQUENCY_HZ))
        found = check.modes(moved)
        for known, true in zip((*found.xx, *found.yy), (*modes.xx, *modes.yy), strict=True):
            assert known.frequency_hz == pytest.approx(true.frequency_hz, rel=1e-4)
            assert known.damping_ratio == pytest.approx(true.damping_ratio, rel=1e-2)


def test_a_mode_that_appears_is_found_although_the_modes_before_are_known() -> None:
    check = StabilityVerification(CUT)
    check.modes(SAMPLED)
    more = replace(MODES, xx=(*MODES.xx, mode_from_stiffness(900.0, 0.01, 3e7)))
    found = check.modes(SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=more.receptance_m_per_n(FREQUENCY_HZ)))
    assert [round(mode.frequency_hz) for mode in found.xx] == [605, 900, 1340]


@pytest.mark.parametrize("damping_ratio", [1e-3, 1e-320])
def test_a_tolerance_that_would_take_too_long_to_verify_is_denied(damping_ratio: float) -> None:
    light = ModalResponse(xx=(mode_from_stiffness(3000.0, damping_ratio, 2e7),))
    check = StabilityVerification(CUT)
    assert "more than 200 speeds within its tolerance" in check.denial(light, 1000.0, 1e-6, 0.02)
    assert "more than 200 speeds" not in check.denial(MODES, 10_200.0, 1.0, 0.02)


def test_what_chatters_between_a_speed_and_the_ends_of_its_tolerance_is_denied() -> None:
    """A heavy, lightly damped spindle: the command may stand at any speed within the tolerance."""
    start_rad, exit_rad = engagement_rad(MillingMode.DOWN, 0.5, 10.0)
    cut = replace(CUT, teeth=6, start_rad=start_rad, exit_rad=exit_rad)
    heavy = ModalResponse(
        xx=(mode_from_stiffness(176.54, 0.00303, 1.20335e7), mode_from_stiffness(297.44, 0.003, 3.88e7)),
        yy=(mode_from_stiffness(144.11, 0.0029, 7.56402e6),),
    )
    method = semi_discretisation(state_space(heavy, 0.0), cut, 200)
    found = [float(spectral_radius(method, 1146.0 * share, np.array([1.7]))[0]) for share in (0.98, 1.0, 1.015, 1.02)]
    assert [radius > 1.0 for radius in found] == [False, False, True, False], found
    check = StabilityVerification(cut)
    assert all(check.is_stable(heavy, 1146.0 * share, 1.7, 0.0) for share in (0.98, 1.0, 1.02))
    assert "does not die away fast enough" in check.denial(heavy, 1146.0, 1.7, 0.02)
    assert check.is_stable(heavy, 1146.0, 1.7, 0.003)


def test_all_feed_directions_must_be_borne() -> None:
    speeds = np.linspace(6000.0, 9000.0, 13).tolist()
    turned = [
        tuple(StabilityVerification(CUT, (feed,)).is_stable(MODES, each, 5.0, 0.0) for each in speeds)
        for feed in (0.0, 90.0)
    ]
    both = tuple(StabilityVerification(CUT, (0.0, 90.0)).is_stable(MODES, each, 5.0, 0.0) for each in speeds)
    assert both == tuple(x and y for x, y in zip(*turned, strict=True))
    assert turned[0] != turned[1]


def sampled(receptance: np.ndarray) -> SampledResponse:
    return SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=receptance.astype(np.complex128))


NOISE = np.random.default_rng(1).normal(size=(len(FREQUENCY_HZ), 2, 2)) * 1e-7


@pytest.mark.parametrize(
    ("response", "words"),
    [
        (sampled(NOISE * np.eye(2)), "no sum of up to 12 modes follows this FRF"),
        (sampled(SAMPLED.receptance + 0.3 * NOISE * np.eye(2)), "the modes follow the FRF with a residual of"),
        (sampled(SAMPLED.receptance + 1e-9), "one axis acts on the other"),
        (
            sampled(SAMPLED.receptance * np.where(FREQUENCY_HZ == 700.0, np.nan, 1.0)[:, None, None]),
            "no finite value at 700 Hz",
        ),
        (sampled(0.0 * SAMPLED.receptance), "both directions are rigid"),
    ],
    ids=["noise", "much noise", "coupled", "NaN", "rigid"],
)
def test_every_doubt_denies_with_the_reason(response: SampledResponse, words: str) -> None:
    check = StabilityVerification(CUT)
    denial = check.denial(response, 7000.0, 0.001, 0.02)
    assert "cannot be verified" in denial
    assert words in denial
    assert not check.is_stable(response, 7000.0, 0.001, 0.02)


def test_the_planner_leaves_out_what_does_not_pass() -> None:
    demand = SpeedDemand(programmed_rpm=10200.0, depth_mm=4.0, margin_fraction=0.2, tolerance_fraction=0.005)
    operation = MillingOperation(demand=demand, feed_mm_min=2040.0, teeth=4, range_rpm=(8200.0, 12000.0))
    known = EstimatedToolPoint(response=MODES, resonance_hz={"x": 605.0, "y": 646.0})

    def lobes_of(response: ToolPointResponse) -> StabilityLobes:
        return zeroth_order_lobes(response, CUT, from_rpm=8000.0, to_rpm=12200.0, points=401)

    alone = SpeedPlanner(operation, lobes_of).choice(known)
    looked_at = SpeedPlanner(operation, lobes_of, StabilityVerification(CUT)).choice(known)
    assert alone.speed_rpm == 10200.0
    assert not all(decays(alone.speed_rpm * share, 4.0, 10.0) for share in (0.995, 1.0, 1.005))
    assert looked_at.stable
    assert looked_at.speed_rpm < 10200.0
    assert all(decays(looked_at.speed_rpm * share, 4.0, 10.0) for share in (0.995, 1.0, 1.005))


OPERATION = MillingOperation(
    demand=SpeedDemand(programmed_rpm=10200.0, depth_mm=4.0, margin_fraction=0.2, tolerance_fraction=0.02),
    feed_mm_min=2040.0,
    teeth=4,
    range_rpm=(8200.0, 12000.0),
)


def wide_lobes(response: ToolPointResponse) -> StabilityLobes:
    return zeroth_order_lobes(response, CUT, from_rpm=8000.0, to_rpm=12300.0, points=401)


def warmer(share: float) -> EstimatedToolPoint:
    modes = ModalResponse(
        xx=tuple(replace(mode, frequency_hz=share * mode.frequency_hz) for mode in MODES.xx),
        yy=tuple(replace(mode, frequency_hz=share * mode.frequency_hz) for mode in MODES.yy),
    )
    return EstimatedToolPoint(response=modes, resonance_hz={"x": 605.0 * share, "y": 646.0 * share})


def test_a_target_that_verification_moves_follows_the_dynamics_without_a_jump() -> None:
    planner = SpeedPlanner(OPERATION, wide_lobes, StabilityVerification(CUT))
    alone = SpeedPlanner(OPERATION, wide_lobes)
    shares = [1.0 + 2e-4 * number for number in range(40)]
    speeds = [planner.choice(warmer(share)).speed_rpm for share in shares]
    assert all(
        speed < alone.choice(warmer(share)).speed_rpm - 50.0 for speed, share in zip(speeds, shares, strict=True)
    )
    steps = np.abs(np.diff(speeds))
    assert steps.max() < 15.0  # the resonance moves by 0.02 %, which is 2 1/min; the edge is known to as much
    assert speeds[-1] > speeds[0] + 20.0


class DeniesAll(StabilityVerification):
    """Verification of a spindle that has changed since."""

    def denial(self, response: ToolPointResponse, speed_rpm: float, depth_mm: float, tolerance: float) -> str:
        return f"{speed_rpm:.0f} 1/min is denied"


def test_where_every_speed_is_denied_the_programmed_one_stays_with_an_alarm() -> None:
    choice = SpeedPlanner(OPERATION, wide_lobes, DeniesAll(CUT)).choice(warmer(1.0))
    assert choice.speed_rpm == 10200.0
    assert not choice.stable
    assert "1/min is denied; the programmed 10200 1/min stays" in str(choice.alarm)
