"""What was read wrong for a while leaves nothing behind in the lags of a model, which last longer than that."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import _place, _said, _without
from twin_loop import Disturbance, Frames, Place, TwinLoop
from whole_loop import lagged_model

from daemon.backup.manifest import Manifest
from daemon.backup.restoring import disarm
from models.control.state import OperatorRequest
from models.records import FloatArray, OutputState
from models.thermal.features import lag_table
from models.thermal.linear import LinearModel

pytestmark = pytest.mark.quiet

MODEL = lagged_model("long", lags_min=(1.0, 10.0))
SHORT = lagged_model("short", lags_min=(1.0, 5.0))
CHANGES = np.outer(np.repeat([1.0, 0.2, -1.2], 5), [0.6, 1.0])
"""Weights of a model that follows how far its temperatures are ahead of their lags [um/K]."""
BEFORE = 200
"""Moments of ten seconds until enough is known of the states and the output follows."""
PLACE = Place(rise_k=np.array([6.0, 5.0, 7.0, 2.0, 3.0]), constant_s=np.full(5, 1500.0))
STEEP = Place(rise_k=np.array([35.0, 30.0, 38.0, 12.0, 13.0]), constant_s=np.full(5, 6000.0))
WITHIN_UM = 1.1


def other_level(sensor: int, begin: int, end: float, codes: int = 192) -> Disturbance:
    """A node says 12 K more than it measures, from one moment to another."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        lies = _place(sensor)[0] == line and begin <= moment < end
        return _said(loop, frames, sensor, codes) if lies else frames

    return disturb


def comes_back_wrong(sensor: int, away: range, end: float, codes: int) -> Disturbance:
    """A node is silent, and says another temperature from its return to a moment."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if _place(sensor)[0] != line or not away.start <= moment < end:
            return frames
        return _without(loop, frames, sensor) if moment in away else _said(loop, frames, sensor, codes)

    return disturb


def wrong_until_it_leaves(sensor: int, wrong: range, back: int, codes: int) -> Disturbance:
    """A node says another temperature, is silent, and comes back as it is."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if _place(sensor)[0] != line or not wrong.start <= moment < back:
            return frames
        return _said(loop, frames, sensor, codes) if moment in wrong else _without(loop, frames, sensor)

    return disturb


def says(sensor: int, *spans: tuple[range, int | None]) -> Disturbance:
    """A node says so many codes more in some moments, and is silent in those with None."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        codes = next((codes for span, codes in spans if moment in span), 0)
        if _place(sensor)[0] != line or codes == 0:
            return frames
        return _without(loop, frames, sensor) if codes is None else _said(loop, frames, sensor, codes)

    return disturb


def from_memory(begin: int, end: int) -> Disturbance:
    """A line answers with what it had at a moment."""
    kept: list[Frames] = []

    def disturb(_loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if line != "spindle" or not begin <= moment < end:
            return frames
        kept.append(frames)
        return kept[0]

    return disturb


def one_after_the_other(*disturbances: Disturbance) -> Disturbance:
    """What arrives has met all of them."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, rng: np.random.Generator) -> Frames:
        for each in disturbances:
            frames = each(loop, moment, line, frames, rng)
        return frames

    return disturb


def _ahead_of_lags() -> LinearModel:
    (vector,), (solution,) = MODEL.test_vectors, MODEL.solutions
    expected_um = (vector.features - vector.reference) @ CHANGES
    return replace(
        MODEL,
        solutions=(replace(solution, weights=CHANGES),),
        test_vectors=(replace(vector, thermal_error_um=expected_um),),
    )


AHEAD_OF_LAGS = _ahead_of_lags()
"""A model to which a lag that was led astray is worth as much as a temperature."""
_twins: dict[tuple[object, ...], list[FloatArray]] = {}
"""What the twin of a model, a warm-up, pauses and positionings applies in each moment [um]."""


def run(
    directory: Path,
    disturbance: Disturbance,
    place: Place,
    moments: int,
    model: LinearModel = MODEL,
    kind: type[TwinLoop] = TwinLoop,
    **how: Any,
) -> tuple[FloatArray, list[OutputState]]:
    """Return how far a loop of a kind is from its twin in every moment [um], and its states."""

    def played(name: str, bad: Disturbance | None, count: int) -> TwinLoop:
        loop = (TwinLoop if bad is None else kind)(
            directory / name,
            model,
            place,
            "checked",
            disturbance=bad,
            before=BEFORE,
            reads_past=True,
            restarting=bad is not None,
            **how,
        )
        asyncio.run(loop.run(count))
        return loop

    key = (id(model), id(place), *sorted(how.items()))
    if len(_twins.get(key, ())) < moments:
        _twins[key] = played("twin", None, moments).applied_um
    loop = played("loop", disturbance, moments)
    return np.array(loop.applied_um) - np.array(_twins[key][:moments]), loop.states


def test_a_sensor_that_lies_for_minutes_and_is_right_again_leaves_nothing_behind(tmp_path: Path) -> None:
    off_um, states = run(tmp_path, other_level(0, 5, 50), PLACE, 90)
    assert states[40] is OutputState.HOLD
    assert states[-1] is OutputState.ACTIVE
    followed = np.array([state is OutputState.ACTIVE for state in states])
    assert followed[60:].all() and np.abs(off_um[60:]).max() <= WITHIN_UM, "from the first move on"


class Released(TwinLoop):
    """Another model is released two minutes after a lie has ended; its lags are made from the history."""

    async def _program(self) -> None:
        await super()._program()
        if self.moment == self.before + 60:
            await self.loop.use_model(replace(SHORT, model_id="released"))


def test_nor_does_it_for_a_model_that_is_released_then(tmp_path: Path) -> None:
    twin, loop = (
        Released(tmp_path / name, SHORT, PLACE, "checked", disturbance=bad, before=BEFORE)
        for name, bad in (("twin", None), ("loop", other_level(0, 8, 50)))
    )
    for each in (twin, loop):
        asyncio.run(each.run(90))
        assert each.loop.thermal._online is not None
        assert each.loop.thermal._online.model.model_id == "released"
    assert loop.states[-1] is OutputState.ACTIVE
    assert np.abs(np.array(loop.applied_um[62:]) - np.array(twin.applied_um[62:])).max() <= 0.5


def test_nor_does_it_over_a_restart(tmp_path: Path) -> None:
    off_um, states = run(tmp_path, other_level(0, 5, 50), PLACE, 120, pauses=(40,), positionings=(65,))
    assert states[45] is OutputState.HOLD
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[75:] - off_um[75]).max() <= WITHIN_UM


def test_what_a_sensor_said_after_it_had_come_back_wrong_leaves_nothing_behind(tmp_path: Path) -> None:
    disturbance = comes_back_wrong(0, range(5, 25), 60, 56)
    off_um, states = run(tmp_path, disturbance, PLACE, 90, AHEAD_OF_LAGS)
    assert states[50] is OutputState.HOLD
    followed = np.array([state is OutputState.ACTIVE for state in states])
    assert followed[65:].all() and np.abs(off_um[65:]).max() <= 0.5


@pytest.mark.parametrize(
    "spans",
    [
        [(range(5, 25), None), (range(25, 42), 56), (range(42, 60), 136)],
        [(range(5, 14), 80), (range(14, 30), None), (range(30, 46), 136)],
    ],
    ids=["jumps once more after it has come back", "had jumped before it left"],
)
def test_nor_does_it_where_a_jump_comes_to_it(tmp_path: Path, spans: list[tuple[range, int | None]]) -> None:
    """The jump is no more to be told of the past before it left: what came between is left out."""
    off_um, states = run(tmp_path, says(0, *spans), PLACE, 90, AHEAD_OF_LAGS)
    assert states[40] is OutputState.HOLD
    followed = np.array([state is OutputState.ACTIVE for state in states])
    assert followed[75:].all() and np.abs(off_um[75:]).max() <= 0.5


def test_nor_does_it_over_a_restart_while_it_is_wrong(tmp_path: Path) -> None:
    disturbance = comes_back_wrong(0, range(5, 25), 50, 56)
    off_um, states = run(tmp_path, disturbance, PLACE, 130, AHEAD_OF_LAGS, pauses=(40,), positionings=(68,))
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[80:] - off_um[80]).max() <= 0.5


class Restored(TwinLoop):
    """A back-up of just before is restored; a person acknowledges, and switches on again."""

    async def _pause(self) -> None:
        await self.loop.rig.history.flushed()
        await self.loop.end()
        self.loop.clock.monotonic_s += 20.0
        disarm(self.loop.configuration.history.path, Manifest.model_construct(created="just now"), "anna")
        self._listen()
        await self._start()

    async def _program(self) -> None:
        await super()._program()
        rig, moment = self.loop.rig, self.moment - self.before
        if moment == 63:
            assert rig.acknowledge("anna") == ""
        if moment == 65:
            assert rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "anna") == ""


def test_nor_does_it_where_a_back_up_is_restored(tmp_path: Path) -> None:
    twin, loop = (
        Restored(
            tmp_path / name,
            AHEAD_OF_LAGS,
            PLACE,
            "checked",
            disturbance=bad,
            before=BEFORE,
            reads_past=True,
            pauses=(60,),
            positionings=(68,),
        )
        for name, bad in (("twin", None), ("loop", comes_back_wrong(0, range(5, 25), 50, 192)))
    )
    for each in (twin, loop):
        asyncio.run(each.run(130))
    off_um = np.array(loop.applied_um) - np.array(twin.applied_um)
    assert loop.states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[80:] - off_um[72]).max() <= 0.5


@pytest.mark.parametrize("codes", [48, 192])
def test_a_sensor_that_jumped_left_and_comes_back_as_it_was_is_followed_again_and_leaves_nothing_behind(
    tmp_path: Path, codes: int
) -> None:
    disturbance = wrong_until_it_leaves(0, range(5, 25), 40, codes)
    off_um, states = run(tmp_path, disturbance, PLACE, 110, AHEAD_OF_LAGS, positionings=(60,))
    assert states[38] is OutputState.HOLD and states[52] is OutputState.ACTIVE
    assert np.abs(off_um[70:] - off_um[70]).max() <= 0.5


def test_a_sensor_that_stays_at_another_level_moves_nothing_after_the_work_is_positioned(tmp_path: Path) -> None:
    off_um, states = run(tmp_path, other_level(0, 5, np.inf), PLACE, 140, positionings=(40,))
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[50:] - off_um[50]).max() <= WITHIN_UM


def test_a_line_that_answered_from_memory_moves_nothing_after_the_work_is_positioned(tmp_path: Path) -> None:
    off_um, states = run(tmp_path, from_memory(5, 65), STEEP, 160, AHEAD_OF_LAGS, positionings=(85,))
    assert states[60] is OutputState.HOLD and states[80] is OutputState.HOLD
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[95:] - off_um[95]).max() <= WITHIN_UM


@pytest.mark.parametrize(
    "wrong", [range(5, 60), range(45, 75)], ids=["jumped before it answered from memory", "after it"]
)
def test_nor_does_a_sensor_of_it_that_jumps_and_is_right_again(tmp_path: Path, wrong: range) -> None:
    """The other half of its jump is what was missed meanwhile: the past was told as wrong as that."""
    disturbance = one_after_the_other(says(0, (wrong, 56)), from_memory(10, 60))
    off_um, states = run(tmp_path, disturbance, PLACE, 110, AHEAD_OF_LAGS)
    assert states[55] is OutputState.HOLD
    assert states[-1] is OutputState.ACTIVE
    followed = np.array([state is OutputState.ACTIVE for state in states])
    assert np.abs(off_um[80:][followed[80:]]).max() <= 0.5


def drifts(sensor: int, span: range, codes: int) -> Disturbance:
    """A node drifts by so many codes, and is right again at once."""

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if _place(sensor)[0] != line or moment not in span:
            return frames
        return _said(loop, frames, sensor, round(codes * (moment - span.start) / len(span)))

    return disturb


def _knows_the_machine() -> LinearModel:
    """The model to which lags are worth much, whose sensors say of each other what warm-ups of the machine do."""
    time_min, rows = np.arange(240.0), []
    for share, after_min in ((1.0, 10.0), (0.6, 20.0), (1.4, 30.0), (0.8, 120.0)):
        degc = np.vstack([PLACE.degc(60.0 * max(minute - after_min, 0.0)) for minute in time_min])
        rows.append(np.hstack([share * (degc - 20.0), *(share * (lag_table(time_min, degc, (1.0, 10.0)) - 20.0))]))
    _, sizes, directions = np.linalg.svd(np.vstack(rows), full_matrices=False)
    remaining = 1.0 / (1.0 + np.square(sizes))
    (solution,) = AHEAD_OF_LAGS.solutions
    return replace(AHEAD_OF_LAGS, solutions=(replace(solution, directions=directions.T, remaining=remaining),))


KNOWS_THE_MACHINE = _knows_the_machine()


ONCE: dict[str, Any] = {"positionings": (90,)}
TWICE: dict[str, Any] = {"positionings": (90, 96), "pauses": (105,), "pause_s": 10.0}


@pytest.mark.parametrize(
    ("codes", "how"),
    [(-64, ONCE), (-128, ONCE), (-64, ONCE | {"pauses": (75,)}), (-128, ONCE | {"pauses": (75,)}), (-128, TWICE)],
    ids=["4 K", "8 K", "4 K, over a restart", "8 K, over a restart", "over a restart after a second positioning"],
)
def test_a_sensor_that_had_drifted_and_jumps_back_leaves_nothing_behind_once_the_work_is_positioned(
    tmp_path: Path, codes: int, how: dict[str, Any]
) -> None:
    """What was read before a jump is told at the level of now, and was as wrong as the drift.

    At a second positioning it was forgotten that the lags had been set right: a restart read the drift into them again.
    """
    off_um, states = run(tmp_path, drifts(0, range(5, 65), codes), PLACE, 160, KNOWS_THE_MACHINE, **how)
    assert states[80] is OutputState.HOLD
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[98:] - off_um[98]).max() <= 0.5


class ReleasedOnceMore(TwinLoop):
    """The same model is released under another name ten minutes after the jump back, and later once more."""

    async def _program(self) -> None:
        await super()._program()
        if (since := self.moment - self.before) in (75, 100):
            await self.loop.use_model(replace(KNOWS_THE_MACHINE, model_id=f"released at {since}"))


def test_nor_does_it_in_a_model_that_is_released_before_or_after_the_work_is_positioned(tmp_path: Path) -> None:
    """One read the past as it was told, as if it had begun with lags that were right: 2.4 and 2.2 um in ACTIVE."""
    bad = drifts(0, range(5, 65), -128)
    off_um, states = run(tmp_path, bad, PLACE, 160, KNOWS_THE_MACHINE, ReleasedOnceMore, positionings=(90,))
    assert states[-1] is OutputState.ACTIVE
    assert np.abs(off_um[98:] - off_um[98]).max() <= 0.5
