"""Learns a type from its machines: what one machine tells, what all of them do, and how good that is on one left out.

What needs rows (`machine_sample`, `machine_summary`) is done machine by machine, wherever a worker is; the rest
(`machine_type`, `left_out_machines`) takes what they send back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import usable_recordings
from models.records import FloatArray
from models.thermal.features import BoolArray, canonical
from models.thermal.start import StartDeviation
from models.thermal.training.fleet.combination import own_ridge, taken_over, weighed
from models.thermal.training.fleet.machine_type import COUNTS, MachineType
from models.thermal.training.fleet.places import Part, matching
from models.thermal.training.fleet.products import (
    DESIGN,
    Products,
    Sample,
    Space,
    points_of,
    products_of,
    sample_of,
    speed_factors,
    summed,
)
from models.thermal.training.fleet.sharing import Sharing
from models.thermal.training.inputs import (
    Inputs,
    averaged_recordings,
    build_inputs,
    require_same_columns,
    unusable_sensors,
    with_sensors,
)
from models.thermal.training.making import fit_start
from models.thermal.training.reversed_runs import turned_runs
from models.thermal.training.trust import half_width_um

MOST_MEMBERS = 64
"""The models of so many machines are kept, and so many are left out in turn, evenly spread over a larger fleet."""
FALLBACK_PENALTY = 1e-3
ONE_SENSOR = 0.99
"""A place that is read from one sensor by more than this share is that sensor's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tested:
    """What a machine keeps so that it can be left out: its first half to learn from, the rest to be judged on."""

    train: tuple[Products, ...]
    """Of its first recordings, one after the other, 10 at most."""
    test: Products
    points: FloatArray
    """Some rows of the rest since the first of their run, shape (n, k)."""
    points_um: FloatArray
    """What was measured there, shape (n, n_channels)."""
    recordings: int
    """How many the rest is."""
    squares_k2: FloatArray
    """Mean products of its temperatures, in the places of the type, about the means of recordings, shape (n, n)."""
    columns: tuple[str, ...]
    """What stands at each place; '' where a mean of several does."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Summary:
    """What a machine tells the fleet."""

    machine: str
    weights: FloatArray
    """Its own model, shape (k, n_channels) [um]."""
    how: str
    """How that was fitted, in words."""
    products: Products
    recordings: int
    stale: int
    """So many of its first recordings are from before a change, and count little."""
    lowest_degc: FloatArray
    highest_degc: FloatArray
    highest_speed_rpm: float
    farthest: FloatArray
    """Rows of `points`, since the first of their run, of all recordings, shape (n, k)."""
    pivots_mm: dict[str, float]
    starts: tuple[StartDeviation, ...]
    """What each recording says of lags that begin at equilibrium, with the machine's own model."""
    tested: Tested | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOut:
    """A machine that was left out, with a number of its own recordings."""

    machine: str
    recordings: int
    tested_on: int
    """So many recordings of it."""
    without_um: FloatArray
    """RMSE without a model [um], shape (n_channels,)."""
    alone_um: FloatArray | None
    """Of the machine's own ridge; None with no recording."""
    with_prior_um: FloatArray
    how: str
    """What it took over from the others."""
    residual_um: FloatArray
    """Measured minus estimated with the prior, at some rows, shape (n, n_channels)."""


def evenly(count: int, most: int = MOST_MEMBERS) -> tuple[int, ...]:
    """Return at most so many of 0 .. count - 1, evenly spread."""
    return tuple(sorted({round(at) for at in np.linspace(0, count - 1, min(count, most))}))


def usable_parts(
    recordings: Sequence[Recording], parts: Sequence[Part], sample_s: float
) -> tuple[list[Recording], tuple[Part, ...], tuple[str, ...]]:
    """Return a machine's recordings and the parts of its sensors, without sensors that cannot be used, and warnings.

    `recordings`: with the same columns. `parts`: of each temperature. `sample_s`: time between averaged rows [s].
    """
    require_same_columns(recordings)
    recordings, warnings = usable_recordings(recordings, rows_needed=False)
    plain = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    left_out = unusable_sensors(plain, np.ones(plain.rows, dtype=np.bool_))
    names = [name for name in recordings[0].temperature_names if name not in left_out]
    if not names:
        raise DatasetError(f"{recordings[0].name}: no temperature can be used; each is constant or mostly missing")
    by_name = dict(zip(recordings[0].temperature_names, parts, strict=True))
    kept = [with_sensors(recording, names) for recording in recordings]
    return kept, tuple(by_name[name] for name in names), warnings


def in_places(
    recordings: Sequence[Recording], table: FloatArray, channels: tuple[str, ...], sample_s: float
) -> list[Recording]:
    """Return recordings with the temperatures at the places of a type, averaged.

    `table`: see `matching`. `channels`: displacement channels of the type; raises DatasetError where one is missing.
    """
    names = tuple(f"P{place + 1}" for place in range(len(table)))
    found = []
    for recording in averaged_recordings(recordings, sample_s):
        missing = ~np.isfinite(recording.temperatures_degc)
        degc = np.where(missing, 0.0, recording.temperatures_degc) @ table.T
        if missing.any():
            degc[missing.astype(np.float64) @ table.T > 0.0] = np.nan
        chosen = recording.with_channels(channels)
        found.append(replace(chosen, temperature_names=names, temperatures_degc=degc, axis_positions=()))
    return found


def machine_sample(
    machine: str,
    recordings: Sequence[Recording],
    parts: Sequence[Part],
    of_type: Sequence[Part],
    channels: tuple[str, ...],
    sample_s: float,
) -> Sample:
    """Return what a machine tells of the space of its type; raises DatasetError.

    `machine`: its name. `recordings`, `parts`: with the same columns, and where each temperature sits. `of_type`,
    `channels`: places of the type's sensors, and its displacement channels. `sample_s`: time between averaged rows [s].
    """
    kept, own, _ = usable_parts(recordings, parts, sample_s)
    table = matching(of_type, own, machine)
    return sample_of(build_inputs(in_places(kept, table, channels, sample_s), sample_s=sample_s))


def machine_summary(
    machine: str,
    recordings: Sequence[Recording],
    parts: Sequence[Part],
    of_type: Sequence[Part],
    channels: tuple[str, ...],
    space: Space,
    *,
    tested: bool,
) -> Summary:
    """Return what a machine tells its fleet; see `machine_sample`. `tested`: it will be left out."""
    sample_s = 60.0 * space.period_min
    kept, own, warnings = usable_parts(recordings, parts, sample_s)
    table = matching(of_type, own, machine)
    each: list[Products] = []
    names: list[str] = []
    squares: list[FloatArray] = []
    points: list[tuple[FloatArray, FloatArray]] = []
    lowest, highest, speed_rpm = np.full(len(of_type), np.inf), np.full(len(of_type), -np.inf), 0.0
    placed = in_places(kept, table, channels, sample_s)
    for recording in placed:
        inputs, reduced, rows = reduced_rows([recording], space)
        if not rows.any():
            continue
        each.append(products_of(inputs, reduced, rows))
        names.append(recording.name)
        squares.append(np.cov(inputs.degc[rows].T, bias=True).reshape(len(of_type), len(of_type)).astype(np.float32))
        points.append(points_of(inputs, reduced, rows))
        lowest = np.minimum(lowest, inputs.degc[rows].min(axis=0))
        highest = np.maximum(highest, inputs.degc[rows].max(axis=0))
        if inputs.speed_rpm is not None:
            speed_rpm = max(speed_rpm, float(np.abs(inputs.speed_rpm[rows]).max()))
    if not each:
        raise DatasetError(f"machine {machine}: no row of its recordings is complete; name complete columns in the map")
    wrong = _turned(each)
    said = _turned_sentences(wrong, names, channels)
    right = [at for at in range(len(each)) if at not in wrong]
    each, points = [each[at] for at in right], [points[at] for at in right]
    counted = weighed(each)
    own_model = own_ridge(counted)
    half = len(each) // 2
    return Summary(
        machine=machine,
        weights=own_model.weights,
        how=own_model.how,
        products=summed(each),
        recordings=len(each),
        stale=sum(one is not other for one, other in zip(each, counted, strict=True)),
        lowest_degc=lowest,
        highest_degc=highest,
        highest_speed_rpm=speed_rpm,
        farthest=np.vstack([x for x, _ in points]).astype(np.float32),
        pivots_mm=dict(kept[0].pivots_mm),
        starts=tuple(
            _start(recording, space, own_model.weights)
            for recording in placed
            if recording.name in {names[at] for at in right}
        ),
        tested=None
        if not tested
        else Tested(
            train=tuple(each[: min(half, max(COUNTS))]),
            test=summed(each[half:]),
            points=np.vstack([x for x, _ in points[half:]]),
            points_um=np.vstack([y for _, y in points[half:]]),
            recordings=len(each) - half,
            squares_k2=np.mean(squares, axis=0),
            columns=tuple(
                kept[0].temperature_names[int(np.argmax(row))] if row.max() > ONE_SENSOR else "" for row in table
            ),
        ),
        warnings=(*said, *warnings),
    )


def _start(recording: Recording, space: Space, weights: FloatArray) -> StartDeviation:
    """Return what a recording in the places of a type says of lags that begin at equilibrium.

    `weights`: of the machine's own model, shape (k, n_channels) [um].
    """
    layout = space.layout
    inputs = build_inputs(
        [recording],
        sample_s=60.0 * space.period_min,
        lags_min=layout.lags_min,
        speed_lags_min=layout.speed_lags_min,
    )
    columns = canonical((space.directions @ weights) * space.gain[:, None], layout, DESIGN)
    factor = speed_factors(layout, inputs.speed_scale_rpm / space.speed_scale_rpm)
    return fit_start(inputs, inputs.trainable(), columns * factor[:, None])


def start_of_type(starts: Sequence[StartDeviation]) -> StartDeviation:
    """Return what the recordings of many machines say together of lags that begin at equilibrium.

    `begun_k` is what is usual among them, root mean square: the largest of a whole fleet would let a machine that is
    switched on warm pass for one at rest.
    """
    rest = np.mean([one.rest_degc for one in starts], axis=0)
    away_k = [float(np.std(one.rest_degc - rest)) for one in starts]
    return StartDeviation(
        covariance_um2=np.mean([one.covariance_um2 for one in starts], axis=0),
        signal_um=np.sqrt(np.mean([np.square(one.signal_um) for one in starts], axis=0)),
        rest_degc=rest,
        spread_k=float(np.sqrt(np.mean([one.spread_k**2 for one in starts]))),
        begun_k=float(np.sqrt(np.mean(np.square(away_k)))),
    )


def _turned(each: Sequence[Products]) -> dict[int, tuple[int, ...]]:
    """Return the recordings of a machine in which channels read the wrong way round, by what all others say."""
    xx, xy, yy = ([getattr(one, name) / one.rows for one in each] for name in ("xx", "xy", "yy"))
    return turned_runs(np.stack(xx), np.stack(xy), np.stack(yy))


def _turned_sentences(
    wrong: Mapping[int, tuple[int, ...]], names: Sequence[str], channels: tuple[str, ...]
) -> tuple[str, ...]:
    return tuple(
        f"{names[at]}: {' and '.join(channels[one] for one in turned)} "
        f"{'reads' if len(turned) == 1 else 'read'} the wrong way round, by what all its other recordings say; nothing "
        "was learned from it. Look how its sensor was mounted, change the sign of the column, and train again"
        for at, turned in wrong.items()
    )


def reduced_rows(recordings: Sequence[Recording], space: Space) -> tuple[Inputs, FloatArray, BoolArray]:
    """Return the rows of recordings in the places of a type, in the directions of its space, and which are complete."""
    layout = space.layout
    inputs = build_inputs(
        recordings,
        sample_s=60.0 * space.period_min,
        lags_min=layout.lags_min,
        speed_lags_min=layout.speed_lags_min,
    )
    if inputs.layout != layout:
        raise DatasetError(
            f"{recordings[0].name}: it has no spindle speed, which the others have; name its column in the map, or "
            "take `speed` out of the maps of all machines"
        )
    factor = speed_factors(layout, inputs.speed_scale_rpm / space.speed_scale_rpm)
    return inputs, space.reduced(inputs.features * factor), inputs.trainable()


def sharing_of(summaries: Sequence[Summary], kept: Sequence[int]) -> Sharing:
    """Return what some of the machines say of each other, by their places."""
    some = [summaries[at] for at in kept]
    return Sharing(np.array([one.weights for one in some]), [one.products for one in some])


def left_out_machines(summaries: Sequence[Summary]) -> list[LeftOut]:
    """Return how good the fleet is on machines that it does not know, by numbers of their own recordings.

    Of the machine that is left out neither model nor displacements are used; the directions are those of all.
    """
    found = []
    kept = evenly(len(summaries))
    sharing = sharing_of(summaries, kept)
    for place, one in enumerate(summaries):
        if one.tested is None:
            continue
        members = sharing.members([row for row, at in enumerate(kept) if at != place])
        for count in COUNTS:
            if count > len(one.tested.train):
                continue
            own = weighed(one.tested.train[:count])
            taken = taken_over(own, members)
            found.append(
                LeftOut(
                    machine=one.machine,
                    recordings=count,
                    tested_on=one.tested.recordings,
                    without_um=one.tested.test.rmse_um(),
                    alone_um=one.tested.test.rmse_um(own_ridge(own).weights) if own else None,
                    with_prior_um=one.tested.test.rmse_um(taken.weights),
                    how=taken.how,
                    residual_um=one.tested.points_um - one.tested.points @ taken.weights,
                )
            )
    return found


def machine_type(
    type_id: str,
    created: str,
    of_type: Sequence[Part],
    channels: tuple[str, ...],
    space: Space,
    summaries: Sequence[Summary],
    left_out: Sequence[LeftOut],
) -> MachineType:
    """Return the type that machines teach.

    `type_id`, `created`: its name, and date and time, ISO 8601. `summaries`: of at least two machines. `left_out`: see
    `left_out_machines`.
    """
    whole = sum((one.products.xx for one in summaries[1:]), summaries[0].products.xx) / len(summaries)
    eigenvalues, vectors = np.linalg.eigh(whole)
    kept = evenly(len(summaries))
    members = sharing_of(summaries, kept).members(range(len(kept)))
    moving = max(int((space.gain > 0.0).sum()), 1)
    remaining = _remaining(eigenvalues, FALLBACK_PENALTY, moving)
    farthest = max(float((np.square(one.farthest @ vectors) @ remaining).max()) for one in summaries)
    band_um = np.full((len(COUNTS), len(channels)), np.nan)
    for row, count in enumerate(COUNTS):
        residuals = [one.residual_um for one in left_out if one.recordings == count]
        if len(residuals) > 1:
            band_um[row] = half_width_um(residuals, len(residuals))
    with_none = [one.with_prior_um / np.maximum(one.without_um, 1e-9) for one in left_out if one.recordings == 0]
    return MachineType(
        type_id=type_id,
        mean_leaves=np.array(with_none) if with_none else None,
        created=created,
        parts=tuple(of_type),
        channels=channels,
        pivots_mm=summaries[0].pivots_mm,
        space=replace(space, directions=(space.directions @ vectors).astype(np.float32)),
        eigenvalues=np.maximum(eigenvalues, 0.0),
        penalty=FALLBACK_PENALTY,
        machines=tuple(summaries[at].machine for at in kept),
        members=np.array([(vectors.T @ one).ravel() for one in members], dtype=np.float32),
        lowest_degc=np.min([one.lowest_degc for one in summaries], axis=0),
        highest_degc=np.max([one.highest_degc for one in summaries], axis=0),
        highest_speed_rpm=max(one.highest_speed_rpm for one in summaries),
        leverage_limit=max(farthest, 1e-12),
        band_um=band_um,
        start=start_of_type([start for one in summaries for start in one.starts]),
    )


def _remaining(eigenvalues: FloatArray, penalty: float, moving: int) -> FloatArray:
    """Return penalty / (eigenvalue + penalty), relative to the mean variance of the columns, see `RidgeProblem`."""
    values = np.maximum(eigenvalues, 0.0)
    unit = penalty * max(float(values.sum()) / moving, 1e-12)
    return np.asarray(unit / (values + unit))
