"""The family of Gaussian processes: a mean of members, some with a part that bends, which goes over to a ridge far out.

A member is a Gaussian process on temperatures, their lags and lagged speed with the kernel
``x^T L x' + a^2 exp(-|z - z'|^2 / 2)`` (L: a prior variance for each group of columns; z: few coordinates of the
features, in length scales). Its linear part is a `Solution`, of which sensors can be left out like of every ridge. What
bends is a sum over rows of training, and so is the deviation of the estimate. Where that exceeds what it was when
left-out runs were predicted, the mean goes over to a ridge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from models.model_file import ModelError, Numbers, Packed, file_text, record_of
from models.records import FloatArray
from models.thermal.estimation import Estimation, Machine
from models.thermal.estimator import LinearEstimator, excluded_sensors
from models.thermal.features import IntArray, design_columns
from models.thermal.known_history import ModelState
from models.thermal.linear import LinearModel, LinearOnline
from models.thermal.model import LinearParameters
from models.thermal.solution import Solution
from models.thermal.start import NORMAL_95

FAMILY = "gaussian"
FADED_DEVIATION = 2.0
"""At this many times the deviation up to which left-out runs were predicted, the ridge is all that counts."""
SURER = 2.576 / NORMAL_95
"""So much wider the doubt in what is imputed holds 99 % where ridges hold 90: what bends takes the errors of a sensor
and its lags apart, which in the linear part make up for each other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bend:
    """What a Gaussian process has beside its linear part, over its training rows."""

    coordinates: Packed
    """From features about their centre to coordinates in length scales, shape (layout.columns, q)."""
    points: Packed
    """Coordinates of the training rows, shape (m, q)."""
    weights_um: Numbers
    """Weight of each training row, times the amplitude squared [um], shape (m, n_channels)."""
    variance: float
    """Amplitude squared, relative to the variance of the displacements."""
    linear_points: Packed
    """Scaled columns of the training rows along the directions of the linear part, shape (m, k)."""
    root: Packed
    """Leading part of a root of the inverse of the covariance of the training rows, shape (m, r)."""

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises ModelError."""
        rows, width = self.points.shape
        shapes = (self.coordinates.shape[1], len(self.weights_um), len(self.linear_points), len(self.root))
        if shapes != (width, rows, rows, rows):
            raise ModelError("mixture.bends", f"has shapes {shapes} for {rows} rows and {width} coordinates")
        for array in (self.coordinates, self.points, self.weights_um, self.linear_points, self.root):
            if not np.isfinite(array).all():
                raise ModelError("mixture.bends", "holds a number that is not finite")
            array.flags.writeable = False
        if not 0.0 <= self.variance < np.inf:
            raise ModelError("mixture.bends", f"variance {self.variance} must be finite and not negative")

    def without(self, linear: Solution, sensors: Sequence[int]) -> "Bend":
        """Return what bends of the process whose linear part does without some sensors.

        With the columns X_S taken out of the covariance of the rows their weights ``K^-1 y`` become
        ``K^-1 y + K^-1 X_S Q[S, S]^-1 w[S]``: what bends takes over a part of what the sensors stood for.

        `linear`: the linear part. `sensors`: indices from 0, with all their lags.
        """
        if not len(sensors) or linear.directions is None:
            return self
        out, _, worth = linear.eliminated(sensors)
        taken = self.linear_points @ (linear.directions[out].T @ worth)
        return replace(self, weights_um=self.weights_um + self.variance * (self.root @ (self.root.T @ taken)))

    def similarity(self, features: FloatArray) -> FloatArray:
        """Return the squared-exponential kernel between features and the training rows, shape (n, m)."""
        at = features @ self.coordinates
        squared = np.square(at).sum(axis=1)[:, None] - 2.0 * at @ self.points.T + np.square(self.points).sum(axis=1)
        return np.asarray(np.exp(-0.5 * np.maximum(squared, 0.0)))

    def since(self, linear: Solution, now: FloatArray, then: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what bends since the reference, and the deviation of the whole estimate given training.

        Result of shapes (n, n_channels) [um], and (n,), relative to the deviation of displacements in training.

        `linear`: the linear part. `now`, shape (n, d), and `then`, shape (d,): features about their centre.
        """
        assert linear.directions is not None
        similar = self.similarity(np.vstack([now, then]))
        change, difference = now - then, similar[:-1] - similar[-1]
        scaled = design_columns(change, linear.layout, linear.design) * linear.gain
        along = scaled.astype(np.float32) @ linear.directions
        shared = along @ self.linear_points.T + self.variance * difference
        apart = np.square(change @ self.coordinates).sum(axis=1)
        before = np.square(scaled).sum(axis=1) - 2.0 * self.variance * np.expm1(-0.5 * apart)
        known = np.square(shared.astype(np.float32) @ self.root, dtype=np.float64).sum(axis=1)
        return difference @ self.weights_um, np.sqrt(np.maximum(before - known, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mixture:
    """How several solutions, some with a bend, make one estimate."""

    bends: tuple[Bend, ...]
    """Of the first solutions, in their order."""
    shares: Numbers
    """Weight of each solution inside the domain, shape (n_solutions,); they sum to 1."""
    outside: int
    """Index of the solution, a ridge, that counts alone far out."""
    deviation_limit: float
    """Deviation up to which left-out runs were predicted."""

    def __post_init__(self) -> None:
        """Check the numbers; raises ModelError."""
        if self.shares.ndim != 1 or np.any(self.shares < 0.0) or not np.isclose(self.shares.sum(), 1.0):
            raise ModelError("mixture.shares", "must be shares that are not negative and sum to 1")
        if not len(self.bends) <= self.outside < len(self.shares):
            raise ModelError("mixture.outside", f"{self.outside} is no ridge among {len(self.shares)} solutions")
        if not self.deviation_limit > 0.0:
            raise ModelError("mixture.deviation_limit", f"{self.deviation_limit} must be positive")
        self.shares.flags.writeable = False

    def coefficients(
        self, solutions: Sequence[Solution], without: Sequence[int] = (), beside: IntArray | None = None
    ) -> FloatArray:
        """Return the coefficients of the linear parts together, see `Solution.coefficients`."""
        counted = [(share, one) for share, one in zip(self.shares, solutions, strict=True) if share > 0.0]
        return np.asarray(np.sum([share * one.coefficients(without, beside) for share, one in counted], axis=0))

    def without(self, solutions: Sequence[Solution], sensors: Sequence[int]) -> "Mixture":
        """Return the mixture of the fits without some sensors (indices from 0), see `Bend.without`."""
        pairs = zip(self.bends, solutions, strict=False)
        return replace(self, bends=tuple(bend.without(linear, sensors) for bend, linear in pairs))

    def bent_um(
        self,
        solutions: Sequence[Solution],
        now: FloatArray,
        then: FloatArray,
        linear_um: FloatArray,
        far_um: FloatArray,
    ) -> FloatArray:
        """Return the thermal error since the reference, shape (n, n_channels) [um].

        `solutions`: of the model. `now`, `then`, shapes (n, d) and (d,): features about their centre, now and at the
        reference, of all sensors. `linear_um`, `far_um`, shape (n, n_channels): what the linear parts together say, and
        what the ridge says that counts far out [um].
        """
        if not self.bends:
            return linear_um
        found, deviation = linear_um, np.zeros(len(now))
        for share, linear, bend in zip(self.shares, solutions, self.bends, strict=False):
            bent_um, uncertain = bend.since(linear, now, then)
            found, deviation = found + share * bent_um, deviation + uncertain / len(self.bends)
        inside = np.clip(FADED_DEVIATION - deviation / self.deviation_limit, 0.0, 1.0)[:, None]
        return np.asarray(inside * found + (1.0 - inside) * far_um)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianModel(LinearModel):
    """Gaussian processes, or their mean with ridges, as the daemon loads them."""

    test_tolerance_um: ClassVar[float] = 1e-2
    """Within what its test vectors are met [um]: the deviation is a difference of sums in single precision."""
    mixture: Mixture

    def __post_init__(self) -> None:
        """Check how the mixture fits the solutions, then all that a linear model checks; raises ModelError."""
        mixture, channels = self.mixture, len(self.channels)
        if len(mixture.shares) != len(self.solutions):
            raise ModelError("mixture.shares", f"holds {len(mixture.shares)} for {len(self.solutions)} solutions")
        for linear, bend in zip(self.solutions, mixture.bends, strict=False):
            directions = 0 if linear.directions is None else linear.directions.shape[1]
            shapes = (len(bend.coordinates), bend.linear_points.shape[1], bend.weights_um.shape[1])
            if shapes != (self.layout.columns, directions, channels):
                raise ModelError("mixture.bends", f"has shapes {shapes}; {self.layout.columns} columns are needed")
        LinearModel.__post_init__(self)

    def coefficients(self, without: tuple[int, ...] = (), beside: IntArray | None = None) -> FloatArray:
        """Return the coefficients of the linear parts [um per unit], without some sensors, shape (d, n_channels)."""
        return self.mixture.coefficients(self.solutions, without, beside)

    @property
    def shares(self) -> FloatArray:
        """How much the linear part of each solution counts, shape (n_solutions,)."""
        return self.mixture.shares

    def error_since_um(
        self, features: FloatArray, reference: FloatArray, elapsed_min: float | FloatArray
    ) -> FloatArray:
        """Return the thermal error since the reference, shape (n_channels,) or (n, n_channels) [um]."""
        change = features - reference
        linear_um = np.atleast_2d(self.thermal_error_um(change, elapsed_min))
        far_um = np.atleast_2d(change @ self.solutions[self.mixture.outside].coefficients())
        now, then = np.atleast_2d(features - self.centre), reference - self.centre
        found = self.mixture.bent_um(self.solutions, now, then, linear_um, far_um)
        return found if features.ndim > 1 else found[0]

    def runtime(self, machine: Machine) -> LinearOnline:
        """Return the model in use on a machine."""
        return LinearOnline(self, machine, GaussianEstimator)

    def to_json(self) -> str:
        """Return the text of its file; numbers are exact, large matrices in single precision."""
        return file_text(FAMILY, self)


class GaussianEstimator(LinearEstimator):
    """Runs a model of Gaussian processes sample by sample, see `LinearEstimator`."""

    def __init__(self, model: LinearParameters, components: Sequence[str] = (), steps_k: Sequence[float] = ()) -> None:
        super().__init__(model, components, steps_k)
        self._latest: tuple[tuple[int, ...], FloatArray, Mixture] | None = None
        self._steeper: tuple[tuple[int, ...], float, float] | None = None

    def _of(self, model: GaussianModel, out: tuple[int, ...]) -> tuple[FloatArray, Mixture]:
        """Return the ridge that counts far out and the mixture, of the latest set of sensors left out."""
        if self._latest is None or self._latest[0] != out:
            far = model.solutions[model.mixture.outside].coefficients(out, self.left_out.beside)
            self._latest = out, far, model.mixture.without(model.solutions, out)
        return self._latest[1:]

    def estimate(self, state: ModelState, reference: ModelState) -> Estimation | None:
        """Return the thermal error since the reference, see `LinearEstimator.estimate`."""
        found = super().estimate(state, reference)
        if found is None:
            return None
        assert isinstance(self.model, GaussianModel)
        model, out = self.model, tuple(self.model.sensor_ids.index(each) for each in found.imputed)
        now, then = self.features(state), self.features(reference)
        far, mixture = self._of(model, out)
        far_um = (now - then) @ far
        both = self.left_out.imputed(np.stack([now, then]) - model.centre, out)
        linear_um = found.thermal_error_um[None]
        bent_um = mixture.bent_um(model.solutions, both[:1], both[1], linear_um, far_um[None])
        if not out:
            return replace(found, thermal_error_um=bent_um[0])
        steeper = self._how_much_steeper(both + model.centre, out, state.time_min)
        more_um = np.sqrt(steeper**2 - 1.0) * found.imputed_um
        wider = np.hypot(found.band_factor, more_um / np.maximum(model.band_um, 1e-9))
        return replace(
            found, thermal_error_um=bent_um[0], imputed_um=SURER * steeper * found.imputed_um, band_factor=wider
        )

    def _how_much_steeper(self, both: FloatArray, out: tuple[int, ...], time_min: float) -> float:
        """Return how much more sensors that do not count move the whole model than its linear part, at least 1.

        `both`, shape (2, d): features now and at the reference, with what the sensors `out` are taken for. It is worked
        out once in a period, at `time_min`.
        """
        if self._steeper is None or self._steeper[0] != out or time_min - self._steeper[1] >= self.model.period_min:
            gone_k = np.isin(np.arange(self.model.layout.sensors), out).astype(np.float64)
            straight_um, bent_um = self._moved_um(both[0], both[1], gone_k, ())
            self._steeper = out, time_min, max(1.0, float(bent_um / max(straight_um, 1e-9)))
        return self._steeper[2]

    def _moved_um(
        self, now: FloatArray, then: FloatArray, off_k: FloatArray, out: tuple[int, ...]
    ) -> tuple[float, float]:
        """Return by how much temperatures that go by so much move the linear part, and the whole estimate [um].

        `now`, `then`, shape (d,): features now and at the reference. `off_k`, shape (n_sensors,): to both sides [K]; a
        lag follows its temperature later. `out`: indices of the sensors that do not count.
        """
        assert isinstance(self.model, GaussianModel)
        model, layout = self.model, self.model.layout
        following = np.tril(np.ones((len(layout.lags_min) + 1,) * 2))
        off = np.zeros((len(following), layout.columns))
        off[:, : layout.temperature_columns] = np.kron(following, off_k)
        rows = np.vstack([now, now + off, now - off])
        if out:
            far, mixture = self._of(model, out)
        else:
            far, mixture = model.solutions[model.mixture.outside].coefficients(), model.mixture
        both = self.left_out.imputed(np.vstack([rows, then]) - model.centre, out)
        linear_um, far_um = (rows - then) @ self.left_out.coefficients(out), (rows - then) @ far
        found_um = mixture.bent_um(model.solutions, both[:-1], both[-1], linear_um, far_um)
        straight_um, bent_um = (float(np.abs(each[1:] - each[0]).max()) for each in (linear_um, found_um))
        return straight_um, bent_um

    def level_um(self, state: ModelState, reference: ModelState, uncertainty_k: FloatArray) -> float:
        """Return by how much the thermal error may be wrong if levels are by so much [K], with what bends there."""
        straight_um = super().level_um(state, reference, uncertainty_k)
        if not uncertainty_k.any():
            return straight_um
        now, then = self.features(state), self.features(reference)
        return max(straight_um, self._moved_um(now, then, uncertainty_k, excluded_sensors(state, reference))[1])


def gaussian_model(content: bytes) -> GaussianModel:
    """Return the model that the content of a file holds; raises ModelError."""
    return record_of(content, GaussianModel)
