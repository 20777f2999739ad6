"""What the output would hold of an estimate: weighed by confidence, held, gone back, moved by probes."""

import numpy as np
import pytest

from models.thermal.training.online import Followed, compensated_um, following_share

MINUTES = np.arange(60.0)


def followed(confidence: float | np.ndarray, in_domain: bool | np.ndarray = True) -> Followed:
    return Followed(
        estimate_um=np.outer(MINUTES, [1.0, -2.0]),
        band_um=np.ones((60, 2)),
        confidence=np.broadcast_to(confidence, 60).astype(float),
        in_domain=np.broadcast_to(in_domain, 60).astype(bool),
        unsure=np.zeros(60, dtype=bool),
        speed_unread=np.zeros(60, dtype=bool),
    )


@pytest.mark.parametrize(("confidence", "weight"), [(1.0, 1.0), (0.9, 1.0), (0.8, 0.5), (0.7, 0.0)])
def test_the_estimate_counts_by_its_confidence(confidence: float, weight: float) -> None:
    held = compensated_um(followed(confidence), MINUTES, np.zeros((60, 2)))
    np.testing.assert_allclose(held, weight * np.outer(MINUTES, [1.0, -2.0]), atol=1e-9)


def test_what_must_not_be_followed_is_held_for_ten_minutes_and_then_taken_back() -> None:
    there = (MINUTES < 20.0) | (MINUTES >= 40.0)
    for part in (followed(np.where(there, 1.0, 0.5)), followed(1.0, there)):
        held = compensated_um(part, MINUTES, np.zeros((60, 2)))[:, 0]
        assert held[19:30].tolist() == [19.0] * 11
        assert held[30:40].tolist() == [0.0] * 10 and held[40] == 40.0
        assert following_share([part]) == pytest.approx(2.0 / 3.0)


def test_a_probe_moves_the_output_to_what_it_measured() -> None:
    measured = np.outer(MINUTES, [1.5, -2.0])
    held = compensated_um(followed(1.0), MINUTES, measured, 20.0)
    left = measured - held
    np.testing.assert_allclose(left[[20, 40]], 0.0, atol=1e-9)
    np.testing.assert_allclose(left[:, 1], 0.0, atol=1e-9)
    assert np.abs(left[20:, 0]).max() <= 0.5 * 20.0
