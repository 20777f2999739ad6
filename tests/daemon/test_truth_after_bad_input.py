"""After bad input has passed, what is applied is what an undisturbed twin applies, or the output holds and says why.

Frames of both lines go through the parser, the thermal task, the control task and the guard's text, on the clock of
the test; the twin hears the same machine without any disturbance.
"""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from bad_input import KINDS
from small_model import model
from twin_loop import TwinLoop, some_places
from whole_loop import lagged_model

from models.records import FloatArray, OutputState
from models.thermal.family import ThermalModel

pytestmark = pytest.mark.quiet

AFTER = 60
"""Moments of ten seconds after the bad input within which the output must be right again."""
LONGEST = 60
"""No bad input takes more moments than this; a twin that goes on for so long is right for all that are shorter."""
WITHIN_UM = 1.0
ROUNDED_UM = 0.1
"""The control rounds what it applies to this on both."""
MODELS: dict[str, ThermalModel] = {"increments": model("increments"), "lagged": lagged_model("lagged")}
FIRST = {"increments": 45, "lagged": 0}
"""Of the warm-up so many moments are left out: two and a half minutes are enough for a model without lags."""
_twins: dict[tuple[object, ...], list[FloatArray]] = {}
"""What the twin of a model, a seed and pauses applies in each moment [um]."""


def outcome(directory: Path, kind: str, name: str, profile: str, seed: int) -> tuple[float, OutputState]:
    """Return how far from its twin a loop ends [um], and in which state."""
    rng = np.random.default_rng(seed)
    places, bad = some_places(rng), KINDS[kind](rng)
    key = (name, seed, bad.pauses)
    if key not in _twins:
        folder, first = directory / f"twin{len(_twins)}", FIRST[name]
        twin = TwinLoop(folder, MODELS[name], places, "checked", pauses=bad.pauses, first=first)
        asyncio.run(twin.run(LONGEST + AFTER))
        _twins[key] = twin.applied_um
    loop = TwinLoop(
        directory / f"{kind}-{name}-{profile}-{seed}",
        MODELS[name],
        places,
        profile,
        disturbance=bad.disturbance,
        seed=seed,
        pauses=bad.pauses,
        restarting=True,
        first=FIRST[name],
    )
    asyncio.run(loop.run(bad.passed + AFTER))
    return float(np.abs(loop.applied_um[-1] - _twins[key][len(loop.applied_um) - 1]).max()), loop.states[-1]


def judge(directory: Path, kind: str, name: str, profile: str, seeds: range) -> None:
    wrong = {}
    for seed in seeds:
        off_um, state = outcome(directory, kind, name, profile, seed)
        if off_um > WITHIN_UM + ROUNDED_UM and state is OutputState.ACTIVE:
            wrong[seed] = off_um
    assert not wrong, f"ended more than {WITHIN_UM:g} um from the twin without a word: {wrong}"


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("kind", KINDS)
def test_after_bad_input_the_tool_stands_where_the_twin_s_does_or_the_output_holds(
    tmp_path_factory: pytest.TempPathFactory, kind: str, name: str
) -> None:
    judge(tmp_path_factory.mktemp("twin"), kind, name, "bare", range(1))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("kind", KINDS)
def test_many_histories_of_bad_input_end_where_the_twin_is(
    tmp_path_factory: pytest.TempPathFactory, kind: str, name: str, times_as_many: int
) -> None:
    """Whole frames are heard alike whether they are checked or not; beside the history that is played always with bare
    frames comes one with checked ones, and when asked to, many more with either.
    """
    directory, end = tmp_path_factory.mktemp("twin"), 1 + 2 * times_as_many
    judge(directory, kind, name, "checked", range(1, end, 2))
    if times_as_many > 1:
        judge(directory, kind, name, "bare", range(2, end, 2))
