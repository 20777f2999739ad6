"""A Gaussian process as a member of a mean: on a part of the lags, with hyper-parameters from the evidence."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, Design, IntArray, Layout, canonical, design_columns
from models.thermal.gaussian import Bend, Mixture
from models.thermal.solution import Solution
from models.thermal.training.families import Fit, fold_numbers
from models.thermal.training.gaussian_process import GaussianProcess, Posterior, Rows, principal_coordinates
from models.thermal.training.inputs import Inputs
from models.thermal.training.lags import columns_of, weighed, widened
from models.thermal.training.left_out_errors import LeftOutErrors, left_out_errors, of_channel

MOST_ROWS = 600
"""So many rows, evenly spread over the training rows, are fitted on: neighbouring rows say nearly the same."""
STEPS = 60
"""Iterations of the search for the hyper-parameters."""
FEW_ROWS = 300
"""Without a fold it goes on on no more than about so many of them: an eighth of the work."""
STEPS_WITHOUT_FOLD = 6
"""Iterations without a fold, so that what is left out has no say in them."""
MOST_DIRECTIONS = 160
"""So many directions of the linear part are kept for leaving sensors out and for the deviation."""
LEAST_KNOWN = 1e-3
"""Directions of which training says less than this share of what the prior says are not kept."""
LIMIT_QUANTILE = 0.9
"""Of the deviations on what was left out: up to there the score tells how good the estimate is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Piece:
    """A fitted member: its linear part, and what bends."""

    solution: Solution
    bend: Bend


class GaussianMember:
    """One Gaussian process on some lags.

    `name`: what reports call it. `inputs`: with the lags of this member alone. `rows`, `fold`, `probe_min`: see
    `Prepare`. `departures`: whether it regresses on temperatures minus their lags in place of the lags.
    """

    def __init__(
        self, name: str, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None, departures: bool
    ) -> None:
        self.name, self.layout = name, inputs.layout
        self._design = Design(departures=departures)
        self._centre = inputs.features.mean(axis=0, where=rows[:, None])
        self._chosen = spread_rows(rows, fold, inputs.run)
        self._fold = fold[self._chosen]
        columns = design_columns(inputs.features[self._chosen] - self._centre, inputs.layout, self._design)
        spread = columns.std(axis=0)
        moves = spread > 1e-9 * np.maximum(1.0, np.abs(self._centre))
        self._groups = tuple(group for each in _groups(inputs.layout) if len(group := each[moves[each]]))
        sizes = np.ones(inputs.layout.columns)
        for group in self._groups:
            sizes[group] = np.sqrt(len(group))
        self._gain = np.where(moves, 1.0 / (np.where(moves, spread, 1.0) * sizes), 0.0)
        scaled = columns * self._gain
        self._along = principal_coordinates(scaled, self._groups)
        values = inputs.cleansed_um[self._chosen]
        self._spread_um = _spread_within_runs(values, inputs.run[self._chosen])
        self._rows = Rows(
            columns=scaled,
            groups=self._groups,
            coordinates=scaled @ self._along,
            run=inputs.run[self._chosen],
            time_min=inputs.time_min[self._chosen],
            values=(values - values.mean(axis=0)) / self._spread_um,
        )
        process = GaussianProcess(self._rows)
        everything = np.arange(len(self._chosen))
        self._few = everything[:: 1 + len(everything) // FEW_ROWS]
        self._logarithms = process.likely(everything, process.first, STEPS)
        self._pieces: dict[frozenset[int], Piece] = {}
        self.errors: LeftOutErrors | None = None
        self.deviation_limit = 1.0
        numbers = fold_numbers(rows, fold)
        if len(numbers) > 1:
            for number in numbers:
                self._pieces[frozenset({number})] = self._made(self._posterior(process, frozenset({number})))
            self._score(inputs, rows, fold, probe_min, numbers)
            self._pieces.clear()  # most members are not chosen, and a piece of hundreds of sensors is some megabytes

    @property
    def hyper_parameters(self) -> list[float]:
        """Return what the evidence chose, the deviations of the groups first, see `GaussianProcess.first`."""
        return [float(value) for value in np.exp(self._logarithms)]

    def _score(
        self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None, numbers: list[int]
    ) -> None:
        deviations = []
        fits = {}
        for number in numbers:
            piece = self.piece(frozenset({number}))
            fits[number] = gaussian_fit([piece], [], self._centre, [1.0])
            out = np.flatnonzero(rows & (fold == number))
            for run in np.unique(inputs.run[out]):
                part = out[inputs.run[out] == run]
                now = inputs.features[part] - self._centre
                deviations.append(piece.bend.since(piece.solution, now, now[0])[1])
        self.errors = left_out_errors(inputs, rows, fold, fits, probe_min)
        self.deviation_limit = max(float(np.quantile(np.concatenate(deviations), LIMIT_QUANTILE)), 1e-6)

    def piece(self, left_out: frozenset[int]) -> Piece:
        """Return the fit on everything but some folds, in the columns of its own layout."""
        if left_out not in self._pieces:
            self._pieces[left_out] = self._made(self._posterior(GaussianProcess(self._rows), left_out))
        return self._pieces[left_out]

    def of_channel(self, channel: int) -> "GaussianMember":
        """Return this member scored on one channel alone; its hyper-parameters are those of all."""
        found = copy(self)
        found.errors = None if self.errors is None else of_channel(self.errors, channel)
        return found

    def _posterior(self, process: GaussianProcess, left_out: frozenset[int]) -> Posterior:
        """Return what all rows but some folds tell."""
        used = np.flatnonzero(~np.isin(self._fold, list(left_out)))
        logarithms = self._logarithms
        if left_out:
            logarithms = process.likely(np.intersect1d(self._few, used), logarithms, STEPS_WITHOUT_FOLD)
        return process.posterior(logarithms, used)

    def _made(self, posterior: Posterior) -> Piece:
        directions, remaining = posterior.directions(MOST_DIRECTIONS, LEAST_KNOWN)
        directions = directions.astype(np.float32)
        coordinates = canonical(self._gain[:, None] * self._along / posterior.length, self.layout, self._design)
        solution = Solution(
            layout=self.layout,
            design=self._design,
            gain=self._gain * posterior.scale,
            weights=posterior.linear * self._spread_um,
            directions=directions,
            remaining=remaining,
        )
        bend = Bend(
            coordinates=coordinates.astype(np.float32),
            points=(posterior.coordinates / posterior.length).astype(np.float32),
            weights_um=posterior.variance * posterior.weights * self._spread_um,
            variance=posterior.variance,
            linear_points=(posterior.columns @ directions).astype(np.float32),
            root=posterior.root(MOST_DIRECTIONS).astype(np.float32),
        )
        return Piece(solution=solution, bend=bend)


def spread_rows(rows: BoolArray, fold: IntArray, run: IntArray) -> IntArray:
    """Return at most about `MOST_ROWS` training rows, evenly spread over every run and fold."""
    used = np.flatnonzero(rows)
    step = max(1, int(np.ceil(len(used) / MOST_ROWS)))
    found = []
    for number in np.unique(run[used]):
        of_run = used[run[used] == number]
        for part in np.unique(fold[of_run]):
            found.append(of_run[fold[of_run] == part][::step])
    return np.sort(np.concatenate(found))


def _groups(layout: Layout) -> list[IntArray]:
    """Return the columns that share a prior variance: temperatures, each of their lags, speed, and its square."""
    sensors = np.arange(layout.sensors)
    found = [layout.sensors * index + sensors for index in range(1 + len(layout.lags_min))]
    found += [np.arange(layout.temperature_columns + power, layout.columns, 2) for power in range(2)]
    return [group for group in found if len(group)]


def _spread_within_runs(values: FloatArray, run: IntArray) -> FloatArray:
    """Return the deviation of each channel about the mean of its run [um], 1 where it does not move."""
    centred = values.copy()
    for number in np.unique(run):
        centred[run == number] -= centred[run == number].mean(axis=0)
    spread = centred.std(axis=0)
    return np.where(spread > 1e-9, spread, 1.0)


def widened_piece(piece: Piece, whole: Layout) -> Piece:
    """Return a fitted member in the columns of a layout that has all of its lags."""
    if piece.solution.layout == whole:
        return piece
    coordinates = np.zeros((whole.columns, piece.bend.coordinates.shape[1]), dtype=np.float32)
    coordinates[columns_of(piece.solution.layout, whole)] = piece.bend.coordinates
    return Piece(solution=widened(piece.solution, whole), bend=replace(piece.bend, coordinates=coordinates))


def weighed_piece(piece: Piece, factor: FloatArray | float) -> Piece:
    """Return a fitted member that counts so many times as much in a mean, of all channels or of each."""
    bend = replace(piece.bend, weights_um=factor * piece.bend.weights_um)
    return Piece(solution=weighed(piece.solution, factor), bend=bend)


def gaussian_fit(
    pieces: list[Piece],
    ridges: list[Solution],
    centre: FloatArray,
    shares: Sequence[float],
    far: Solution | None = None,
    deviation_limit: float = 1.0,
    without: tuple[int, ...] = (),
) -> Fit:
    """Return the weighted mean of Gaussian processes and ridges as a fit.

    `pieces` and `ridges`: the members, in one layout. `centre`, shape (d,): mean of the features in training. `shares`:
    weight of each, those of the processes first. `far`: the ridge that counts alone far out; None: the mean counts
    everywhere. `deviation_limit`: see `Mixture`. `without`: sensors left out of it.
    """
    solutions = [*(piece.solution for piece in pieces), *ridges]
    of_each = np.array(shares, dtype=np.float64)
    outside = len(pieces)
    if far is not None and far in ridges:
        outside = len(pieces) + ridges.index(far)
    elif far is not None:
        solutions, of_each, outside = [*solutions, far], np.append(of_each, 0.0), len(solutions)
    elif not ridges:
        solutions, of_each = [*solutions, solutions[0]], np.append(of_each, 0.0)
    mixture = Mixture(
        bends=tuple(piece.bend for piece in pieces),
        shares=of_each,
        outside=outside,
        deviation_limit=deviation_limit if far is not None else 1e12,
    )
    coefficients = mixture.coefficients(solutions, without)
    return Fit(
        coefficients=coefficients,
        drift_um_per_min=np.zeros(coefficients.shape[1]),
        refit=lambda sensors: gaussian_fit(
            pieces, ridges, centre, shares, far, deviation_limit, tuple(sorted({*without, *sensors}))
        ),
        solutions=tuple(solutions),
        mixture=mixture.without(solutions, without),
        centre=centre,
        without=without,
    )
