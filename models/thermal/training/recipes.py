"""The registry of recipes: how each kind of model is prepared, fitted and made. A new one is one line here."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray
from models.thermal.training.advice import advice
from models.thermal.training.choice import PLAIN, ChosenProblem
from models.thermal.training.families import Prepare
from models.thermal.training.folds import FEWEST_CYCLES
from models.thermal.training.increment_family import (
    IncrementChoices,
    IncrementProblem,
    increments_with_drift,
    increments_without_drift,
)
from models.thermal.training.inputs import Inputs
from models.thermal.training.linear_families import LassoProblem, PartialLeastSquaresProblem
from models.thermal.training.making import Fitted, make_linear_model
from models.thermal.training.ridge_member import RidgeFamily


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How recordings become a model."""

    name: str
    """What a person asks for; model IDs begin with it."""
    kind: str
    """What the model says it is."""
    prepare: Prepare
    lags: bool
    """It works on temperatures, their lags and lagged speed; else on temperatures alone."""
    fewest_runs: int = FEWEST_CYCLES
    """With fewer runs than this, spindle cycles or blocks are left out in turn, and not runs."""
    needed_lags_min: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Lags of temperatures and of speed that it needs [min]; None: those that the rows can teach."""
    rows_needed: bool = True
    """The recordings must have more rows than temperatures; not where a type knows the rest."""
    make: Callable[[Fitted], ThermalModel] = make_linear_model
    """Makes the model of what was fitted."""
    advice: Callable[[Inputs, BoolArray, int], tuple[str, ...]] = advice
    """Says what to record next."""


RECIPES = {
    "default": Recipe(
        name="default",
        kind="default",
        prepare=partial(ChosenProblem, (*PLAIN, "lags", "gaussian")),
        lags=True,
    ),
    "lags": Recipe(name="lags", kind="lags", prepare=partial(ChosenProblem, ("lags",)), lags=True),
    "gaussian": Recipe(name="gaussian", kind="gaussian", prepare=partial(ChosenProblem, ("gaussian",)), lags=True),
    "increments": Recipe(name="increments", kind="increments", prepare=increments_without_drift, lags=False),
    "increments-b0": Recipe(name="increments-b0", kind="increments", prepare=increments_with_drift, lags=False),
    "ridge": Recipe(name="ridge", kind="ridge", prepare=RidgeFamily, lags=False),
    "pls": Recipe(name="pls", kind="pls", prepare=PartialLeastSquaresProblem, lags=False),
    "lasso": Recipe(name="lasso", kind="lasso", prepare=LassoProblem, lags=False),
}
"""Name -> recipe."""


def increment_recipe(choices: IncrementChoices) -> Recipe:
    """Return the recipe of the dissertation's model as a person wants it."""
    kind = "increments" if choices.ridge_k2 is None else "ridge"
    interval = "" if choices.interval_min is None else f"-{choices.interval_min:g}min"
    return Recipe(
        name=f"{kind}{interval}", kind=kind, prepare=partial(IncrementProblem, choices), lags=False, fewest_runs=2
    )
