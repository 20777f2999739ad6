"""A default model of a machine with hundreds of sensors, with numbers that mean nothing."""

import numpy as np

from models.records import FloatArray
from models.thermal.features import Design, Layout
from models.thermal.linear import LinearModel
from models.thermal.model import Domain, TestVector
from models.thermal.sensor_watch import SensorWatch
from models.thermal.solution import Solution

DIRECTIONS = 400


def large_model(sensors: int) -> LinearModel:
    """Two ridges on temperatures, four lags and lagged speed, and a watch, as training makes them."""
    rng = np.random.default_rng(0)
    layout = Layout(sensors=sensors, lags_min=(10.0, 30.0, 90.0, 240.0), speed_lags_min=(3.0, 10.0, 30.0, 90.0, 240.0))
    watched = Layout(sensors=sensors, lags_min=(10.0, 90.0), speed_lags_min=(10.0, 90.0))
    columns, of_watch = layout.columns, watched.columns
    solutions = tuple(
        Solution(
            layout=layout,
            design=Design(departures=departures),
            gain=rng.uniform(0.1, 1.0, columns),
            weights=rng.normal(0.0, 1e-2, (columns, 5)),
            directions=np.linalg.qr(rng.normal(size=(columns, DIRECTIONS)))[0].astype(np.float32),
            remaining=rng.uniform(1e-3, 1.0, DIRECTIONS),
        )
        for departures in (True, False)
    )
    coefficients = np.mean([one.coefficients() for one in solutions], axis=0)
    now, then = _features(rng, columns), _features(rng, columns)
    root = rng.normal(0.0, of_watch**-0.5, (of_watch, of_watch))
    return LinearModel(
        model_id="large",
        kind="default",
        channels=("x1", "x2", "y1", "y2", "z"),
        sensor_ids=tuple(range(1, sensors + 1)),
        sensor_names=tuple(f"T{number}" for number in range(1, sensors + 1)),
        layout=layout,
        speed_scale_rpm=6000.0,
        period_min=1.0,
        solutions=solutions,
        drift_um_per_min=np.zeros(5),
        centre=_features(rng, columns),
        domain=Domain(
            of_increments=False,
            lowest=np.full(sensors, 10.0),
            highest=np.full(sensors, 40.0),
            highest_speed_rpm=6000.0,
            leverage_limit=100.0,
        ),
        band_um=np.ones(5),
        watch=SensorWatch(
            layout=watched,
            centre=_features(rng, of_watch),
            gain=rng.uniform(0.1, 1.0, of_watch),
            precision=(np.eye(of_watch) + root @ root.T).astype(np.float32),
            threshold_k=np.ones(sensors),
            slew_k_per_min=np.full(sensors, 10.0),
            flat_min=np.full(sensors, 15.0),
            speed_scale_rpm=6000.0,
        ),
        hyper_parameters={},
        refused=None,
        training=(),
        created="2026-01-01T00:00:00+00:00",
        test_vectors=(
            TestVector(features=now, reference=then, elapsed_min=0.0, thermal_error_um=(now - then) @ coefficients),
        ),
    )


def _features(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.normal(22.0, 2.0, count)
