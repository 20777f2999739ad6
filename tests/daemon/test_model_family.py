"""A family of models of its own: two lines of registration, and all that is done with models works with it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from control_rig import SENSOR_IDS
from model_folder import configured, open_folder
from searched_once import searched_once
from thermal_rig import Task

from config.schema.compensation import ReleaseConfig
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released
from daemon.model_release.releasing import release
from daemon.workbench.thermal.evaluation import Protocol, evaluate
from models.model_file import ModelError, Numbers, file_text, record_of
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.estimation import Estimation, Machine, OnlineReference, Samples
from models.thermal.family import FAMILIES, model_from_json
from models.thermal.model import TrainingData
from models.thermal.training.families import Fit, HyperParameters
from models.thermal.training.inputs import Inputs
from models.thermal.training.making import Fitted
from models.thermal.training.recipes import RECIPES, Recipe
from models.thermal.training.train_family import train_family

MINUTES = 180


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanTemperature:
    """Thermal error as a multiple of the rise of the mean of all temperatures: no matrix, no sensor of its own."""

    model_id: str
    kind: str
    channels: tuple[str, ...]
    sensor_ids: tuple[int, ...]
    sensor_names: tuple[str, ...]
    um_per_k: Numbers
    band_um: Numbers
    refused: str | None
    training: tuple[TrainingData, ...]
    test_vectors: tuple[str, ...] = ()
    axis_positions: tuple[str, ...] = ()
    probing: None = None
    needs_speed = False

    def __post_init__(self) -> None:
        if self.um_per_k.shape != (len(self.channels),):
            raise ModelError("um_per_k", "one for each channel")

    @property
    def period_s(self) -> float | None:
        return None

    @property
    def pivots_mm(self) -> dict[str, float]:
        return {}

    @property
    def hyper_parameters(self) -> dict[str, float]:
        return {}

    def runtime(self, machine: Machine) -> "MeanOnline":
        return MeanOnline(self)

    def recorded_um(
        self, time_min: FloatArray, degc: FloatArray, speed_rpm: FloatArray | None, first: int
    ) -> FloatArray:
        mean = degc.mean(axis=1)
        return np.outer(mean[first:] - mean[first], self.um_per_k)

    def to_json(self) -> str:
        return file_text("mean", self)


class MeanOnline:
    """Each sensor's own reference; a sensor that returns is set anew by the mean of the others."""

    def __init__(self, model: MeanTemperature) -> None:
        self.model, self._then = model, np.full(len(model.sensor_ids), np.nan)

    history_min, memory_min, filled, inputs = 0.0, 0.0, 1.0, "temperatures"
    kept: dict[str, Any] | None = None

    def level_um(self, doubt_k: FloatArray) -> float:
        return float(np.abs(self.model.um_per_k).max() * np.abs(doubt_k).mean())

    @property
    def excluded(self) -> dict[int, str]:
        return {}

    def rebuild(self, history: Samples, wrong: Mapping[int, str] = MappingProxyType({})) -> None:
        raise AssertionError("there are no states")

    def on_sample(self, time_min: float, degc: FloatArray, speed_rpm: float) -> None: ...

    def jumped(self, jump_k: FloatArray) -> None: ...

    def set_reference(self, reference: OnlineReference) -> tuple[int, ...]:
        self._then = reference.degc.copy()
        return ()

    def estimate(
        self, time_min: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> tuple[Estimation | None, tuple[int, ...]]:
        known = np.isfinite(degc)
        stayed, back = known & ~absent & np.isfinite(self._then), known & (absent | ~np.isfinite(self._then))
        if not stayed.any():
            return None, ()
        rise_k = float((degc - self._then)[stayed].mean())
        self._then = np.where(back, degc - rise_k, self._then)
        estimation = Estimation(
            thermal_error_um=rise_k * self.model.um_per_k,
            confidence=float(stayed.mean()),
            in_domain=True,
            imputed=tuple(i for i, here in zip(self.model.sensor_ids, known, strict=True) if not here),
            outside=(),
        )
        return estimation, tuple(i for i, anew in zip(self.model.sensor_ids, back, strict=True) if anew)

    @property
    def reference_degc(self) -> FloatArray:
        return self._then


class MeanProblem:
    """Least squares of the displacement on the mean temperature, without the folds that are left out."""

    def __init__(
        self, inputs: Inputs, rows: npt.NDArray[np.bool_], fold: npt.NDArray[np.intp], _: float | None
    ) -> None:
        self._inputs, self._rows, self._fold = inputs, rows, fold
        self.hyper_parameters: HyperParameters = {"of": "the mean"}

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        rows = self._rows & ~np.isin(self._fold, list(left_out))
        mean, um = self._inputs.degc[rows].mean(axis=1), self._inputs.cleansed_um[rows]
        gain = (mean - mean.mean()) @ (um - um.mean(axis=0)) / np.square(mean - mean.mean()).sum()
        sensors = self._inputs.layout.sensors
        fit = Fit(
            coefficients=np.outer(np.full(sensors, 1.0 / sensors), gain),
            drift_um_per_min=np.zeros(len(gain)),
            refit=lambda _: fit,
        )
        return fit


def make(fitted: Fitted) -> MeanTemperature:
    return MeanTemperature(
        model_id=f"{fitted.name}-1",
        kind=fitted.kind,
        channels=fitted.inputs.channels,
        sensor_ids=fitted.sensor_ids,
        sensor_names=fitted.inputs.sensor_names,
        um_per_k=fitted.fit.coefficients.sum(axis=0),
        band_um=fitted.trust.band_um,
        refused=fitted.trust.refused,
        training=fitted.training,
    )


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FAMILIES, "mean", lambda content: record_of(content, MeanTemperature))
    monkeypatch.setitem(RECIPES, "mean", Recipe(name="mean", kind="mean", prepare=MeanProblem, lags=False, make=make))


def run(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    heat = np.interp(np.arange(MINUTES), [0, 90, 180, 270, MINUTES], [0.0, 8.0, 1.0, 9.0, 0.5])
    degc = 21.0 + np.outer(heat, np.linspace(0.5, 1.5, len(SENSOR_IDS))) + rng.normal(0.0, 0.02, (MINUTES, 5))
    um = np.column_stack([3.0 * heat, -1.5 * heat]) + rng.normal(0.0, 0.05, (MINUTES, 2))
    return Recording(
        name=f"run {seed}",
        time_s=60.0 * np.arange(float(MINUTES)),
        speed_rpm=None,
        temperature_names=tuple(f"t{i}" for i in SENSOR_IDS),
        temperatures_degc=degc,
        displacement_names=("Y1", "Z1"),
        displacements_um=um,
    )


@pytest.fixture
def trained() -> MeanTemperature:
    made = train_family([run(1), run(2), run(3)], "mean", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(made, MeanTemperature)
    return made


def test_it_is_trained_and_judged_like_every_other(trained: MeanTemperature) -> None:
    np.testing.assert_allclose(trained.um_per_k, [3.0, -1.5], rtol=0.01)
    assert trained.refused is None and np.all(trained.band_um < 1.0)
    assert trained.sensor_ids == SENSOR_IDS
    protocol = Protocol(leave_out="runs")
    found = evaluate([run(1), run(2), run(3)], 60.0, "mean", protocol, lambda *_: None)
    assert found["mean"]["reduction_rmse"] > 0.95 and found["refused"] is None


def test_its_file_gives_it_back(trained: MeanTemperature) -> None:
    again = model_from_json(trained.to_json(), "m.json")
    assert isinstance(again, MeanTemperature) and again.to_json() == trained.to_json()
    assert json.loads(trained.to_json())["family"] == "mean"
    with pytest.raises(ModelError, match=r"m\.json: sha256: does not fit"):
        model_from_json(trained.to_json().replace('"kind": "mean"', '"kind": "other"'), "m.json")


def test_it_is_released_and_loaded(trained: MeanTemperature) -> None:
    with open_folder() as folder:
        configuration = configured(folder, release=ReleaseConfig(largest_band_um=5.0))
        proposal = folder / "state/proposals/p.json"
        proposal.write_text(trained.to_json(), encoding="utf-8")
        release(configuration, proposal, person="anna")
        lenient = configured(folder, allow_writable_model_directory=True)
        found = load_released(lenient, own_account())
        assert isinstance(found.model, MeanTemperature), found.inhibit


async def test_it_runs_on_line_and_the_return_of_a_sensor_moves_nothing(
    tmp_path: Path, trained: MeanTemperature
) -> None:
    task = Task(tmp_path, replace(trained, sensor_ids=SENSOR_IDS, um_per_k=np.array([2.0, -1.0])))  # type: ignore[arg-type]
    task.history.start()
    try:
        await task.minutes(2)
        await task.ask()
        await task.minutes(2, spindle=22.0, column=22.0)
        assert task.estimates[-1].thermal_error_um == pytest.approx([4.0, -2.0])
        await task.minutes(3, spindle=[np.nan, 22.0, 22.0], column=22.0)
        assert task.estimates[-1].imputed == (1,)
        await task.minutes(2, spindle=[60.0, 22.0, 22.0], column=22.0)
        assert task.estimates[-1].thermal_error_um == pytest.approx([4.0, -2.0])
        assert task.estimates[-1].imputed == ()
        await task.minutes(2, spindle=[65.0, 22.0, 22.0], column=22.0)
        assert task.estimates[-1].thermal_error_um == pytest.approx([6.0, -3.0]), "and then it counts"
    finally:
        task.history.close()


def test_every_kind_that_training_makes_can_be_loaded() -> None:
    """A recipe whose model no family reads would be a file that the daemon refuses."""
    for name in set(RECIPES) - {"mean"}:
        with searched_once():
            made = train_family(
                [run(1), run(2), run(3)], name, sample_s=60.0, created="2026-01-01T00:00:00+00:00"
            ).model
        assert type(model_from_json(made.to_json(), name)) is type(made)
        of: Mapping[str, Any] = json.loads(made.to_json())
        assert of["family"] in FAMILIES
