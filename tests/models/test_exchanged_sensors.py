"""Two sensors whose cables were exchanged between recordings are named, with the recording, and no others."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.recordings.exchanged_sensors import exchanges
from models.recordings.findings import usable_recordings
from models.records import FloatArray

SHARES = np.array([[1.0, 0.2], [0.8, 0.5], [0.3, 1.0], [0.5, 0.6], [0.1, 0.9], [0.9, 0.1]])
MORE = np.vstack([SHARES, SHARES + 0.15, SHARES[::-1] - 0.05])


def run(seed: int, heats: tuple[float, float] = (1.0, 1.0), shares: FloatArray = SHARES) -> Recording:
    """Sensors that see two heats in different shares, with offsets of their own and 0.1 K resolution."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 3.0 * 3600.0, 60.0)
    quick = heats[0] * rng.uniform(6.0, 14.0) * -np.expm1(-time_s / 1800.0)
    slow = heats[1] * (rng.uniform(4.0, 8.0) * -np.expm1(-time_s / 9000.0) + np.sin(time_s / 4000.0 + seed))
    degc = 20.0 + rng.normal(0.0, 0.5, len(shares)) + np.column_stack([quick, slow]) @ shares.T
    return Recording(
        name=f"run{seed}.csv",
        time_s=time_s,
        speed_rpm=None,
        temperature_names=tuple(f"T{i + 1}" for i in range(len(shares))),
        temperatures_degc=np.round(degc + rng.normal(0.0, 0.03, degc.shape), 1),
        displacement_names=("Z1",),
        displacements_um=(quick + slow)[:, None],
    )


RUNS = [run(seed) for seed in range(6)]


def exchanged(recordings: Sequence[Recording], one: int, other: int, where: Sequence[int]) -> list[Recording]:
    order = list(range(recordings[0].sensors))
    order[one], order[other] = other, one
    return [
        replace(recording, temperatures_degc=recording.temperatures_degc[:, order]) if index in where else recording
        for index, recording in enumerate(recordings)
    ]


@pytest.mark.parametrize(("one", "other"), [(0, 2), (1, 4), (2, 5)])
@pytest.mark.parametrize("first", [2, 3, 4])
def test_two_that_were_exchanged_from_one_recording_on_are_named(one: int, other: int, first: int) -> None:
    (found,) = exchanges(exchanged(RUNS, one, other, range(first, 6)))
    assert (found.first, found.alone, found.sensors) == (first, False, (one, other)) and found.by_k > 0.5


@pytest.mark.parametrize("number", [0, 2, 5])
def test_two_that_were_exchanged_in_one_recording_are_named(number: int) -> None:
    (found,) = exchanges(exchanged(RUNS, 0, 4, [number]))
    assert (found.first, found.alone, found.sensors) == (number, True, (0, 4))


def test_of_two_recordings_the_second_is_named_and_two_pairs_are_both_found() -> None:
    (found,) = exchanges(exchanged(RUNS[:2], 0, 4, [1]))
    assert (found.first, found.alone, found.sensors) == (1, False, (0, 4))
    many = [run(seed, shares=MORE) for seed in range(6)]
    both = exchanges(exchanged(exchanged(many, 0, 4, [3, 4, 5]), 2, 5, [3, 4, 5]))
    assert {one.sensors for one in both} == {(0, 4), (2, 5)}


def test_the_warning_says_which_from_where_on_and_what_to_do_and_blames_no_other() -> None:
    _, warnings = usable_recordings(exchanged(RUNS, 1, 4, [3, 4, 5]))
    assert warnings == (
        "run3.csv: column T2: does from this recording on what T5 did before, and T5 what T2 did (1.5 K off): the two "
        "seem to be exchanged. Look where their cables go, and exchange the two names in the header of the files that "
        "are wrong, or train without those files (--without)",
    )


@pytest.mark.parametrize(
    ("pairs", "first"), [(((0, 2), (1, 3)), 3), (((0, 4), (2, 5)), 2), (((0, 2), (1, 4)), 2), (((2, 4), (1, 5)), 3)]
)
def test_of_two_pairs_among_six_sensors_none_is_named_alone_where_others_explain_as_much(
    pairs: tuple[tuple[int, int], tuple[int, int]], first: int
) -> None:
    """Before, healthy T5 and T6 were said to be exchanged for each other; nobody can know which of the six it was."""
    recordings = RUNS
    for one, other in pairs:
        recordings = exchanged(recordings, one, other, range(first, 6))
    (found,) = exchanges(recordings)
    assert {sensor for pair in pairs for sensor in pair} <= set(found.among)
    _, warnings = usable_recordings(recordings)
    assert not any("what T" in warning for warning in warnings)
    names = ", ".join(f"T{sensor + 1}" for sensor in found.among)
    (said,) = [warning for warning in warnings if "several seem to be exchanged" in warning]
    assert f"column {names}: some of these temperatures do from this recording on what others of them do" in said


def test_another_regime_from_one_recording_on_and_sensors_that_agree_are_no_exchange() -> None:
    assert exchanges(RUNS) == [] == exchanges(RUNS[:1]) == exchanges([])
    other = [run(seed, (0.1, 2.0)) for seed in (3, 4, 5)]
    assert exchanges([*RUNS[:3], *other]) == []
    assert exchanges([run(seed, (1.5, 0.0)) for seed in (0, 1, 2)] + other) == []
