"""Principal components against scikit-learn, and dimensions that are known."""

import numpy as np
import pytest
from sklearn.decomposition import PCA

from models.thermal.training.principal_components import differences, principal_components


def test_components_are_scikit_learns() -> None:
    values = np.random.default_rng(1).normal(size=(200, 6)) @ np.diag([5.0, 3.0, 2.0, 1.0, 0.5, 0.1])
    found, reference = principal_components(values), PCA().fit(values)
    assert found.cumulative == pytest.approx(np.cumsum(reference.explained_variance_ratio_), rel=1e-10)
    assert np.abs(np.sum(found.loadings.T * reference.components_, axis=1)) == pytest.approx(np.ones(6), abs=1e-9)
    assert np.abs(found.loadings).max(axis=0) == pytest.approx(found.loadings.max(axis=0)), "largest entry positive"


def test_dimensions_count_what_is_there() -> None:
    rng = np.random.default_rng(2)
    two = rng.normal(size=(500, 2)) @ rng.normal(size=(2, 10))
    assert principal_components(two).dimensions() == 2
    equal = np.vstack([np.eye(4), -np.eye(4)])
    assert principal_components(equal).dimensions() == 4
    assert principal_components(equal).dimensions(share=0.5) == 2
    assert principal_components(two).dimensions(share=0.01) == 1


def test_noise_needs_more_dimensions_over_short_times_than_over_long() -> None:
    rng = np.random.default_rng(3)
    slow = np.outer(np.linspace(0.0, 4.0, 400) ** 2, rng.uniform(0.5, 1.5, 12)) + rng.normal(0.0, 0.02, (400, 12))
    dimensions = [principal_components(differences([slow], rows)).dimensions() for rows in (1, 120)]
    assert dimensions[0] > dimensions[1]
