"""A model of a machine that takes over what its type knows: an ordinary linear model, made and judged as any other.

With recordings of the machine itself, or the mean of the fleet without any.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from models.recordings.dataset import DatasetError
from models.recordings.findings import counted
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray, Layout, design_columns
from models.thermal.linear import LinearModel
from models.thermal.model import CHANNEL_SCORES, Domain, HyperParameters, TestVector
from models.thermal.solution import Solution
from models.thermal.training.advice import more_runs, still_channels
from models.thermal.training.families import Fit, fold_numbers, ridge_fit
from models.thermal.training.fleet.combination import FEW, taken_over, weighed
from models.thermal.training.fleet.machine_type import COUNTS, MachineType
from models.thermal.training.fleet.places import Part, matching
from models.thermal.training.fleet.products import DESIGN, MOST_AT_ONCE, Products, products_of, speed_factors, summed
from models.thermal.training.inputs import Inputs
from models.thermal.training.making import (
    Fitted,
    digest,
    in_single_precision,
    make_linear_model,
    sensor_ids_from_names,
)
from models.thermal.training.recipes import Recipe
from models.thermal.training.trust import Trust

KIND = "fleet"
FEWEST_LEFT_OUT = 3
"""The mean of a type is trusted when it was tried on so many machines that were left out."""


def prior_recipe(of_type: MachineType, parts: Mapping[str, Part], machine: str) -> Recipe:
    """Return how a machine's recordings become a model with what its type knows.

    `parts`: where each of its temperatures sits, by column. `machine`: its name, for messages.
    """
    layout = of_type.space.layout
    return Recipe(
        name=of_type.type_id,
        kind=KIND,
        prepare=partial(PriorProblem, of_type, parts, machine),
        lags=True,
        needed_lags_min=(layout.lags_min, layout.speed_lags_min),
        rows_needed=False,
        make=partial(_make, of_type, parts, machine),
        advice=_advice,
    )


def _advice(inputs: Inputs, rows: BoolArray, independent: int) -> tuple[str, ...]:
    """Return what to record next beside what the type knows: families and what takes long are known from there."""
    runs = len(np.unique(inputs.run[rows]))
    if runs > FEW:
        return still_channels(inputs, rows)
    sentence = (
        f"of {counted(runs, 'recording')} a combination of its sisters' models is made, and no watch of the sensors: "
        f"record {more_runs(FEW + 1 - runs)}, a warm-up and a cooling of this machine, and train again with all of "
        "them; where this one is refused, --prior without recordings makes the mean of the type's models until then"
    )
    return (sentence, *still_channels(inputs, rows))


def _but(channels: tuple[str, ...], weights: FloatArray) -> str:
    """Return which channels nothing was taken over for, after what was."""
    none = [channel for channel, column in zip(channels, weights.T, strict=True) if not column.any()]
    if not none:
        return ""
    return f", and nothing for {', '.join(none)}, whose error that makes larger: it may be reversed or swapped"


class Sister:
    """A machine's columns in the directions of its type, and what the type knows of them.

    `of_type`: the type. `own`: where each of the machine's temperatures sits. `speed_scale_rpm`: speed that stands for
    1 in its features. `machine`: its name, for messages. Raises DatasetError when it shares too few sensors.
    """

    def __init__(self, of_type: MachineType, own: tuple[Part, ...], speed_scale_rpm: float, machine: str) -> None:
        space, whole = of_type.space, of_type.space.layout
        self.layout = Layout(sensors=len(own), lags_min=whole.lags_min, speed_lags_min=whole.speed_lags_min)
        self.from_own = matching(of_type.parts, own, machine)
        self.to_own = matching(own, of_type.parts, machine)
        factor = speed_factors(whole, speed_scale_rpm / space.speed_scale_rpm)
        directions = np.asarray(space.directions, dtype=np.float64)
        self.reducing = self._blocks(self.from_own.T, (factor * space.gain)[:, None] * directions)
        spread = np.where(space.gain > 0.0, 1.0 / np.where(space.gain > 0.0, space.gain, 1.0), 0.0) / factor
        own_spread = self._blocks(self.to_own, spread[:, None])[:, 0]
        moves = own_spread > 0.0
        self.gain = np.where(moves, 1.0 / np.where(moves, own_spread, 1.0), 0.0)
        known = self._blocks(self.to_own, spread[:, None] * directions) * self.gain[:, None]
        principal, sizes, _ = np.linalg.svd(known * np.sqrt(of_type.eigenvalues), full_matrices=False)
        values = np.square(sizes)
        unit = of_type.penalty * max(float(of_type.eigenvalues.sum()) / max(int((space.gain > 0.0).sum()), 1), 1e-12)
        self._directions, self._remaining = principal, unit / (values + unit)

    def _blocks(self, table: FloatArray, columns: FloatArray) -> FloatArray:
        """Return a table applied to the temperatures and to each of their lags; speed as it is."""
        size = table.shape[1]
        temperatures = 1 + len(self.layout.lags_min)
        parts = [table @ columns[at * size : (at + 1) * size] for at in range(temperatures)]
        return np.vstack([*parts, columns[temperatures * size :]])

    def reduced(self, features: FloatArray) -> FloatArray:
        """Return the machine's features in the directions of the type, shape (n, k)."""
        parts = [
            design_columns(features[at : at + MOST_AT_ONCE], self.layout, DESIGN) @ self.reducing
            for at in range(0, len(features), MOST_AT_ONCE)
        ]
        return np.vstack(parts)

    def solution(self, weights: FloatArray) -> Solution:
        """Return weights in the directions of the type, shape (k, n_channels), as a solution on the machine."""
        moves = self.gain > 0.0
        columns = (self.reducing @ weights) / np.where(moves, self.gain, 1.0)[:, None]
        return Solution(
            layout=self.layout,
            design=DESIGN,
            gain=self.gain.copy(),
            weights=np.where(moves[:, None], columns, 0.0),
            directions=self._directions,
            remaining=self._remaining.copy(),
        )


class PriorProblem:
    """What a machine takes over from its type; see `Prepare` for the parameters that are not of the type."""

    def __init__(
        self,
        of_type: MachineType,
        parts: Mapping[str, Part],
        machine: str,
        inputs: Inputs,
        rows: BoolArray,
        fold: IntArray,
        probe_min: float | None,
    ) -> None:
        layout = of_type.space.layout
        if layout.speed_lags_min and not inputs.layout.speed_lags_min:
            raise DatasetError(
                f"{inputs.recording_names[0]}: it has no spindle speed, which the type {of_type.type_id} needs; name "
                "its column in the map"
            )
        if lacking := [channel for channel in inputs.channels if channel not in of_type.channels]:
            raise DatasetError(
                f"{inputs.recording_names[0]}: the type {of_type.type_id} knows nothing of channel {lacking[0]}; it "
                f"has {', '.join(of_type.channels)}: choose among them with --channels"
            )
        own = tuple(parts[name] for name in inputs.sensor_names)
        self.sister = Sister(of_type, own, inputs.speed_scale_rpm, machine)
        self._members = of_type.models[:, :, [of_type.channels.index(channel) for channel in inputs.channels]]
        reduced, self._runs = self.sister.reduced(inputs.features), len(np.unique(inputs.run[rows]))
        self._products: dict[int, Products] = {
            number: products_of(inputs, reduced, rows & (fold == number))
            for number in (*fold_numbers(rows, fold), -1)
            if (rows & (fold == number)).any()
        }
        self._whole = products_of(inputs, reduced, rows)
        counted = weighed([*self._products.values()]) if self._runs > FEW else [*self._products.values()]
        stale = sum(one is not other for one, other in zip(counted, self._products.values(), strict=True))
        self._products = dict(zip(self._products, counted, strict=True))
        taken = taken_over(self._some(frozenset()), self._members)
        self._fitter = taken.fitter
        self.hyper_parameters: HyperParameters = {
            "type": of_type.type_id,
            "taken_over": taken.how + _but(inputs.channels, taken.weights),
            "machines": len(of_type.machines),
            "stale_recordings": stale,
            "lags_min": list(layout.lags_min),
            "speed_lags_min": list(layout.speed_lags_min),
        }

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds; the mean of the fleet where nothing is left."""
        some = self._some(left_out)
        weights = self._fitter(some) if some else self._members.mean(axis=0)
        return ridge_fit([self.sister.solution(weights)])

    def _some(self, left_out: frozenset[int]) -> list[Products]:
        """Return the recordings without some folds; one or two recordings as one, whatever they are cut into."""
        if self._runs <= FEW and not left_out:
            return [self._whole]
        some = [one for number, one in self._products.items() if number not in left_out]
        return [summed(some)] if some and self._runs <= FEW else some


def _make(of_type: MachineType, parts: Mapping[str, Part], machine: str, fitted: Fitted) -> LinearModel:
    """Return the model with the domain and the band of its type, where these are wider than what was seen of it."""
    model = make_linear_model(fitted)
    assert isinstance(model, LinearModel)
    own = tuple(parts[name] for name in fitted.inputs.sensor_names)
    to_own = matching(own, of_type.parts, machine)
    domain = model.domain
    chosen = [of_type.channels.index(channel) for channel in model.channels]
    runs = len(np.unique(fitted.inputs.run[fitted.rows]))
    known = [row for row, count in enumerate(COUNTS) if count <= runs and np.isfinite(of_type.band_um[row]).all()]
    band_um = np.maximum(model.band_um, of_type.band_um[known[-1], chosen]) if known else model.band_um.copy()
    return replace(
        model,
        watch=model.watch if runs > FEW else None,  # a watch that knows one day takes the next one for faults
        domain=replace(
            domain,
            lowest=np.minimum(domain.lowest, to_own @ of_type.lowest_degc),
            highest=np.maximum(domain.highest, to_own @ of_type.highest_degc),
            highest_speed_rpm=max(domain.highest_speed_rpm, of_type.highest_speed_rpm),
            leverage_limit=max(domain.leverage_limit or 0.0, of_type.leverage_limit),
        ),
        band_um=band_um,
    )


def mean_of_type(
    of_type: MachineType, parts: Mapping[str, Part], machine: str, created: str
) -> tuple[LinearModel, Trust]:
    """Return the mean of the fleet's models on a machine of which nothing was recorded, and how far it may be trusted.

    What judges it are the machines that were left out when the type was learned: each was one of which nothing was
    known. It carries no watch of its sensors, and what its lags are worth after a start is what the fleet's
    recordings say.

    Raises DatasetError where the machine shares too few sensors with the type.

    `of_type`: the type. `parts`: where each of the machine's temperatures sits, by its usual name, such as `T61`.
    `machine`: its name, for messages. `created`: date and time for the model, ISO 8601.
    """
    space, names, own = of_type.space, tuple(parts), tuple(parts.values())
    sister, channels = Sister(of_type, own, space.speed_scale_rpm, machine), len(of_type.channels)
    solution = in_single_precision(sister.solution(of_type.models.mean(axis=0)))
    lowest, highest = (sister.to_own @ degc for degc in (of_type.lowest_degc, of_type.highest_degc))
    middle, cold, warm = (
        _features(sister.layout, degc, speed)
        for degc, speed in (((lowest + highest) / 2.0, 0.0), (lowest, 0.0), (highest, 1.0))
    )
    trust = _trust_of_mean(of_type)
    scores = {} if of_type.mean_leaves is None else {CHANNEL_SCORES: of_type.mean_leaves.mean(axis=0).round(4).tolist()}
    weights = solution.coefficients()
    model = LinearModel(
        model_id=f"{of_type.type_id}-mean-{digest(weights)[:8]}",
        kind=KIND,
        channels=of_type.channels,
        sensor_ids=sensor_ids_from_names(names),
        sensor_names=names,
        layout=sister.layout,
        speed_scale_rpm=space.speed_scale_rpm,
        period_min=space.period_min,
        solutions=(solution,),
        drift_um_per_min=np.zeros(channels),
        centre=middle,
        domain=Domain(
            of_increments=False,
            lowest=lowest,
            highest=highest,
            highest_speed_rpm=of_type.highest_speed_rpm,
            leverage_limit=of_type.leverage_limit,
        ),
        band_um=trust.band_um.copy(),
        watch=None,
        hyper_parameters={
            "type": of_type.type_id,
            "taken_over": "the mean of the machines' models",
            "machines": len(of_type.machines),
            "lags_min": list(sister.layout.lags_min),
            "speed_lags_min": list(sister.layout.speed_lags_min),
            **scores,
        },
        refused=trust.refused,
        training=(),
        created=created,
        pivots_mm=dict(of_type.pivots_mm),
        start=None
        if of_type.start is None
        else replace(of_type.start, rest_degc=sister.to_own @ of_type.start.rest_degc),
        test_vectors=tuple(
            TestVector(features=now, reference=then, elapsed_min=0.0, thermal_error_um=(now - then) @ weights)
            for now, then in ((warm, cold), (middle, cold))
        ),
    )
    return model, trust


def _features(layout: Layout, degc: FloatArray, speed: float) -> FloatArray:
    """Return the features of a machine that has been at temperatures and a speed for long."""
    temperatures = np.tile(degc, 1 + len(layout.lags_min))
    return np.concatenate([temperatures, np.full(layout.columns - layout.temperature_columns, speed)])


def _trust_of_mean(of_type: MachineType) -> Trust:
    """Return what machines that were left out say of the mean of the others."""
    leaves, refused = of_type.mean_leaves, None
    if leaves is None or len(leaves) < FEWEST_LEFT_OUT:
        refused = (
            f"the type {of_type.type_id} does not say what its mean leaves on {FEWEST_LEFT_OUT} machines that were "
            "left out: learn it from more machines, or record this one"
        )
    elif not (worst := float(leaves.mean(axis=1).max())) < 1.0:
        refused = (
            f"on a machine that was left out {worst:.0%} of the error remains with the mean of the others, which is no "
            "better than no compensation: record this one"
        )
    return Trust(
        refused=refused,
        band_um=np.asarray(of_type.band_um[COUNTS.index(0)], dtype=np.float64).copy(),
        held_out_relative_rmse=float("nan") if leaves is None else float(leaves.mean()),
        forward_skill=(),
    )
