"""How much each member of a mean counts: by what the mean leaves of left-out runs."""

import numpy as np
import pytest

from models.thermal.training.left_out_errors import LeftOutErrors, mean_errors, relative
from models.thermal.training.mixing import MOST_MEMBERS, mean_weights

RUNS, ROWS = 6, 80
MEASURED = [np.cumsum(np.random.default_rng(run).normal(0.0, 1.0, (ROWS, 2)), axis=0) for run in range(RUNS)]


def member(residual_um: list[np.ndarray], probe_min: float | None = None) -> LeftOutErrors:
    return LeftOutErrors(
        folds=np.arange(RUNS),
        measured_um=tuple(MEASURED),
        residual_um=tuple(residual_um),
        period_min=1.0,
        probe_min=probe_min,
    )


def noise(seed: int, size: float, common: list[np.ndarray] | None = None) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    own = [rng.normal(0.0, size, (ROWS, 2)) for _ in range(RUNS)]
    return own if common is None else [one + other for one, other in zip(own, common, strict=True)]


def test_members_that_err_differently_are_mixed_and_the_bad_one_is_not() -> None:
    tried = [member(noise(1, 1.0)), member(noise(2, 1.0)), member(noise(3, 6.0))]
    weights, _ = mean_weights(tried)
    assert weights == pytest.approx({0: 0.5, 1: 0.5}, abs=0.17)
    mixed = mean_errors([tried[index] for index in weights], list(weights.values()))
    assert relative(mixed) < 0.8 * min(relative(one) for one in tried)


def test_weights_are_even_where_chosen_ones_are_not_clearly_better() -> None:
    """Ten members that err alike by chance: what was added to the best one followed what is left by chance."""
    tried = [member(noise(seed, 1.0)) for seed in range(10)]
    weights, _ = mean_weights(tried)
    assert len(weights) == MOST_MEMBERS and set(weights.values()) == {1.0 / MOST_MEMBERS}


def test_weights_are_chosen_where_that_is_clearly_better() -> None:
    """The second errs as the first does and a quarter more, on every run: half of it makes the mean worse."""
    common = noise(7, 1.0)
    tried = [member(common), member([1.25 * each for each in common])]
    assert mean_weights(tried)[0] == {0: 1.0}
    assert mean_weights(tried, mixed=False)[0] == {0: 0.5, 1: 0.5}


def test_what_a_mean_leaves_of_a_fold_is_by_weights_that_had_no_say_in_it() -> None:
    """On the first run the member is perfect that is bad on all others: it must not be thanked for that run."""
    good, lucky = noise(1, 1.0), noise(2, 5.0)
    lucky[0] = np.zeros((ROWS, 2))
    weights, left = mean_weights([member(good), member(lucky)])
    assert weights[0] > 0.9
    assert left.residual_um[0] == pytest.approx(good[0])
