"""Machines of a fleet that are connected otherwise than all others are named, and spoil nothing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.training.fleet.fleet import Summary, left_out_machines, machine_sample, machine_summary
from models.thermal.training.fleet.odd_machines import exchanged_sensors, odd_machines, sentences
from models.thermal.training.fleet.places import Part, places_of_type
from models.thermal.training.fleet.products import space_of

BODIES, SENSORS, CHANNELS = 5, 8, ("Y", "Z")
PARTS = tuple(Part(component="machine", part=f"place {at}", label="") for at in range(SENSORS))


def days(machine: int, *, spread: float = 0.2, count: int = 4) -> list[Recording]:
    """Recordings of a chain of bodies that the spindle heats at one end; a sister's departs by `spread`."""
    own = np.random.default_rng([machine, 5])
    capacity = np.array([20e3, 40e3, 80e3, 160e3, 60e3]) * np.exp(spread * own.standard_normal(BODIES))
    between = np.array([60.0, 25.0, 40.0, 12.0]) * np.exp(spread * own.standard_normal(BODIES - 1))
    grows_um = np.array([[4.0, -2.0], [3.0, 5.0], [-2.0, 2.0], [1.0, 3.0], [2.0, -1.0]])
    grows_um = grows_um * np.exp(spread * own.standard_normal((BODIES, 2)))
    place = np.arange(SENSORS) * (BODIES - 1) / (SENSORS - 1)
    shares = np.maximum(1.0 - np.abs(place[:, None] - np.arange(BODIES)), 0.0)
    found = []
    for number in range(count):
        rng = np.random.default_rng([machine, number])
        speeds = np.repeat(rng.permutation([0.0, 3000.0, 6000.0, 9000.0, 0.0, 7000.0]), 50)
        room, degc = 20.0 + rng.uniform(-3.0, 3.0), []
        body = np.full(BODIES, room)
        for speed in speeds:
            flow = between * np.diff(body)
            heat = np.append(flow, 0.0) - np.append(0.0, flow) - 3.0 * (body - room)
            heat[0] += speed / 15.0
            body = body + 60.0 * heat / capacity
            degc.append(body)
        bodies = np.array(degc)
        found.append(
            Recording(
                name=f"day{number + 1}.csv",
                time_s=60.0 * np.arange(len(speeds)),
                speed_rpm=speeds,
                temperature_names=tuple(f"T{at + 1}" for at in range(SENSORS)),
                temperatures_degc=bodies @ shares.T + rng.normal(0.0, 0.03, (len(speeds), SENSORS)),
                displacement_names=CHANNELS,
                displacements_um=(bodies - room) @ grows_um + rng.normal(0.0, 0.1, (len(speeds), 2)),
            )
        )
    return found


@pytest.fixture(scope="module")
def fleet() -> dict[str, list[Recording]]:
    return {f"mill-{machine}": days(machine) for machine in range(1, 6)}


def summaries(fleet: dict[str, list[Recording]]) -> list[Summary]:
    places = places_of_type([PARTS] * 2)
    space = space_of([machine_sample(name, read, PARTS, places, CHANNELS, 60.0) for name, read in fleet.items()])
    return [machine_summary(name, read, PARTS, places, CHANNELS, space, tested=True) for name, read in fleet.items()]


def said(found: Sequence[Summary]) -> dict[str, list[str]]:
    """Everything that is said of the machines, those without a word left out."""
    odd = sentences(odd_machines(found), exchanged_sensors(found), CHANNELS)
    told = {one.machine: [*odd.get(one.machine, []), *one.warnings] for one in found}
    told |= {one.machine: [*told[one.machine], f"{one.stale} stale"] for one in found if one.stale}
    return {machine: words for machine, words in told.items() if words}


def turned(recording: Recording) -> Recording:
    return replace(recording, displacements_um=recording.displacements_um * [1.0, -1.0])


def test_honest_sisters_are_not_accused(fleet: dict[str, list[Recording]]) -> None:
    assert said(summaries(fleet)) == {}
    found = said(summaries(fleet | {"mill-3": days(13, spread=0.6)}))
    assert not any("exchanged" in words or "wrong way" in words for of in found.values() for words in of)


def test_two_sensors_exchanged_on_one_machine_are_named(fleet: dict[str, list[Recording]]) -> None:
    order = [0, 5, 2, 3, 4, 1, 6, 7]
    wrong = [replace(one, temperatures_degc=one.temperatures_degc[:, order]) for one in fleet["mill-3"]]
    found = said(summaries(fleet | {"mill-3": wrong}))
    assert list(found) == ["mill-3"]
    assert found["mill-3"][0].startswith("column T2 does what T6 does on the other machines, and T6 what T2 does there")


def test_a_column_in_fahrenheit_is_named_once_with_its_recordings(fleet: dict[str, list[Recording]]) -> None:
    wrong = [
        replace(one, temperatures_degc=one.temperatures_degc * [1.8, *[1.0] * 7] + [32.0, *[0.0] * 7])
        for one in fleet["mill-3"]
    ]
    sentence = said(summaries(fleet | {"mill-3": wrong}))["mill-3"][-1]
    assert sentence.startswith("day1.csv, day2.csv, day3.csv and 1 more: column T1: stays far above all others")
    assert "temperature_units: {'T1': degF}" in sentence
    told = said(summaries(fleet | {"mill-3": [*fleet["mill-3"][:3], wrong[3]]}))["mill-3"]
    assert any(sentence.startswith("day4.csv: column T1: stays far above") for sentence in told)


def test_a_recording_with_a_channel_turned_round_teaches_nothing_and_is_named(
    fleet: dict[str, list[Recording]],
) -> None:
    clean = summaries(fleet)
    found = summaries(fleet | {"mill-3": [*fleet["mill-3"][:3], turned(fleet["mill-3"][3])]})
    assert said(found)["mill-3"][0].startswith(
        "day4.csv: Z reads the wrong way round, by what all its other recordings"
    )
    assert (found[2].recordings, clean[2].recordings) == (3, 4)
    assert list(said(found)) == ["mill-3"]


def test_a_machine_with_a_channel_turned_round_is_named_and_found_before_those_that_it_spoils(
    fleet: dict[str, list[Recording]],
) -> None:
    found = summaries(fleet | {"mill-3": [turned(one) for one in fleet["mill-3"]]})
    assert {machine: its.turned for machine, its in odd_machines(found).items()} == {"mill-3": (1,)}
    (sentence,) = said(found)["mill-3"]
    assert sentence.startswith("Z reads the wrong way round, by what all other machines say; nothing was learned")
    right = [one for one in found if one.machine != "mill-3"]
    of_right, of_all = (
        {one.machine: one.with_prior_um[1] for one in left_out_machines(some) if one.recordings == 0}
        for some in (right, found)
    )
    assert sum(of_right.values()) < 0.7 * sum(of_all[name] for name in of_right)


def test_a_machine_of_which_the_others_know_little_teaches_nothing(fleet: dict[str, list[Recording]]) -> None:
    strange = [replace(one, displacements_um=one.displacements_um[:, ::-1] * [-2.0, 1.0]) for one in fleet["mill-3"]]
    (sentence,) = said(summaries(fleet | {"mill-3": strange}))["mill-3"]
    assert (
        "so nothing was learned from it: sensors or channels may be swapped" in sentence
        or "wrong way round" in sentence
    )
    few = dict(list((fleet | {"mill-3": strange}).items())[1:4])
    assert odd_machines(summaries(few)) == {}, "of three nobody knows which is strange"


def with_none_um(found: Sequence[Summary], names: Sequence[str]) -> float:
    """What the others leave of the error of some machines, without a recording of their own."""
    left = [one.with_prior_um.mean() for one in left_out_machines(found) if one.recordings == 0]
    return float(sum(um for one, um in zip(found, left, strict=True) if one.machine in names))


def test_a_machine_with_a_single_poor_recording_does_not_spoil_what_the_others_learn(
    fleet: dict[str, list[Recording]],
) -> None:
    noise_um = 8.0 * np.random.default_rng(3).standard_normal((60, 2)).cumsum(axis=0)
    (day,) = fleet["mill-3"][:1]
    poor = replace(
        day,
        time_s=day.time_s[:60],
        speed_rpm=None if day.speed_rpm is None else day.speed_rpm[:60],
        temperatures_degc=day.temperatures_degc[:60],
        displacements_um=day.displacements_um[:60] + noise_um,
    )
    others = [name for name in fleet if name != "mill-3"]
    clean = with_none_um(summaries({name: fleet[name] for name in others}), others)
    assert with_none_um(summaries(fleet | {"mill-3": [poor]}), others) < 1.3 * clean


def test_a_change_in_the_middle_is_known_from_one_odd_day() -> None:
    before, after = days(3, count=6), days(3, count=9)[6:]
    changed = [replace(one, displacements_um=one.displacements_um[:, ::-1]) for one in after]
    others = {f"mill-{machine}": days(machine) for machine in (1, 2)}
    assert summaries(others | {"mill-3": [*before, *changed]})[2].stale == 6
    assert summaries(others | {"mill-3": [*before, changed[0], *after[1:]]})[2].stale == 0
