"""The published thermal behaviour of the machine, asked of the simulated one on its nominal day."""

from dataclasses import dataclass

import numpy as np
import pytest

from drivers.sim.machine.body import warm_temperatures
from drivers.sim.machine.day import SPREAD, Day
from drivers.sim.machine.heat import INDEX, Drive
from drivers.sim.machine.plant import MAX_STEP_S, Plant
from drivers.sim.machine.structure import CHANNELS, Structure
from models.records import FloatArray

X, Y1, Y2, Z1, Z2, Z3 = range(len(CHANNELS))
MINUTE = round(60 / MAX_STEP_S)


def run(plant: Plant, degc: FloatArray, minutes: float, speed_rpm: float, *, chiller: bool = True) -> FloatArray:
    """Return the temperatures at every minute, the start included."""
    drive = Drive(spindle_speed_rpm=speed_rpm, chiller=chiller, feeding=False)
    rows = [degc]
    for step in range(round(minutes * MINUTE)):
        degc = plant.advance(degc, time_s=step * MAX_STEP_S, duration_s=MAX_STEP_S, drive=drive)
        if (step + 1) % MINUTE == 0:
            rows.append(degc)
    return np.array(rows)


def shape(temperatures: FloatArray) -> FloatArray:
    """Return the displacements since the first row [um]."""
    rows = np.array([Structure().displacement_um(row) for row in temperatures])
    return rows - rows[0]


def first_order_fit(minutes: FloatArray, um: FloatArray) -> tuple[float, float, float]:
    """Return time constant [min], end value and residual RMS [um] of a (1 - exp(-t/tau)), by least squares.

    The amplitude is solved exactly for each time constant; the best of 2000 time constants between
    1 and 2000 min is taken. The fit covers the 2 h of rotation, one value a minute, from its start.
    """
    best = (np.inf, 0.0, 0.0)
    for tau in np.geomspace(1.0, 2000.0, 2000):
        basis = 1.0 - np.exp(-minutes / tau)
        amplitude = basis @ um / (basis @ basis)
        best = min(best, (float(np.sqrt(np.mean((um - amplitude * basis) ** 2))), float(tau), float(amplitude)))
    return best[1], best[2], best[0]


@dataclass(frozen=True)
class Behaviour:
    cold: FloatArray
    warm: FloatArray
    after_idle_reduction: FloatArray
    warm_degc: FloatArray
    idle_reduction_degc: FloatArray
    standby_degc: FloatArray


@pytest.fixture(scope="module")
def plant() -> Plant:
    return Plant(Day.nominal())


@pytest.fixture(scope="module")
def behaviour(plant: Plant) -> Behaviour:
    warm = run(plant, warm_temperatures(plant), 120, 12000)
    idle = run(plant, warm[-1], 180, 0, chiller=False)
    return Behaviour(
        cold=shape(run(plant, plant.cold(), 120, 12000)),
        warm=shape(warm),
        after_idle_reduction=shape(run(plant, idle[-1], 120, 12000)),
        warm_degc=warm,
        idle_reduction_degc=idle,
        standby_degc=run(plant, warm[-1], 180, 0),
    )


def test_time_constants_after_warm_operation(behaviour: Behaviour) -> None:
    minutes = np.arange(121.0)
    for channel, published_min in ((Z2, 14.3), (Y2, 88.0)):
        tau_min, end_um, rest_um = first_order_fit(minutes, behaviour.warm[:, channel])
        assert tau_min == pytest.approx(published_min, rel=0.15)
        assert end_um < -5
        assert rest_um < 0.03 * abs(end_um)


def test_cold_start_is_largest_in_z_and_late_in_y(behaviour: Behaviour) -> None:
    cold, others = behaviour.cold, (behaviour.warm, behaviour.after_idle_reduction)
    assert -60 < cold[-1, Z2] < -20
    assert all(abs(cold[-1, Z2]) > 1.5 * np.abs(other[:, Z2]).max() for other in others)
    assert all(abs(cold[-1, Y2]) > np.abs(other[:, Y2]).max() for other in others)
    assert np.abs(cold[:21, Y2]).max() < 1.0
    slope, intercept = np.polyfit(np.arange(30.0, 121.0), cold[30:, Y2], 1)
    assert slope < 0
    assert -intercept / slope == pytest.approx(20.0, abs=5.0)
    assert np.corrcoef(np.arange(30.0, 121.0), cold[30:, Y2])[0, 1] ** 2 > 0.985


def test_cold_start_settles_after_two_measurement_cycles(plant: Plant) -> None:
    degc = plant.cold()
    ends = []
    for _ in range(4):
        rotation = run(plant, degc, 120, 12000)
        degc = run(plant, rotation[-1], 180, 0)[-1]
        ends.append(shape(rotation)[-1, Y2])
    assert abs(ends[0]) > 1.4 * abs(ends[2])
    assert ends[3] == pytest.approx(ends[2], abs=1.0)


def test_rotation_after_idle_reduction(behaviour: Behaviour) -> None:
    um = behaviour.after_idle_reduction
    assert np.abs(um[:61, Z2]).max() <= 5.0
    assert np.abs(um[:61, Z1]).max() <= 5.0
    assert um[15, Y2] == pytest.approx(-5.0, abs=0.75)
    assert abs(um[15, Y2]) > 2 * abs(behaviour.warm[15, Y2])


def test_inclination_about_doubles_after_idle_reduction(behaviour: Behaviour) -> None:
    warm, idle = (um[60, Y2] - um[60, Y1] for um in (behaviour.warm, behaviour.after_idle_reduction))
    assert warm < -0.5
    assert idle / warm == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("speed_rpm", [2000, 4000, 6000])
def test_low_speeds_move_z_by_at_most_three_micrometres(plant: Plant, behaviour: Behaviour, speed_rpm: float) -> None:
    um = shape(run(plant, behaviour.standby_degc[-1], 120, speed_rpm))
    assert np.abs(um[:, [Z1, Z2]]).max() <= 3.0


def test_test_bar_follows_room_and_nose(plant: Plant, behaviour: Behaviour) -> None:
    """Regress the bar's growth on the two temperatures over runs in which they vary independently."""
    rows = []
    for outside_k in (-2.0, 0.0, 2.0):
        degc = behaviour.standby_degc[-1].copy()
        for name in ("air_low", "air_high", "column_front", "saddle_front", "bed_front"):
            degc[INDEX[name]] += outside_k
        for speed_rpm in (0, 8000, 12000):
            rows.append(run(plant, degc, 90, speed_rpm)[::10])
    temperatures = np.concatenate(rows)
    um = np.array([Structure().displacement_um(row) for row in temperatures])
    room = temperatures[:, [INDEX["air_low"], INDEX["air_high"]]].mean(axis=1)
    features = np.column_stack([np.ones(len(um)), room, temperatures[:, INDEX["nose"]]])
    length = um[:, Z1] - um[:, Z2]
    weights, *_ = np.linalg.lstsq(features, length, rcond=None)
    explained = 1 - np.var(length - features @ weights) / np.var(length)
    assert explained > 0.8
    assert (weights[1:] > 0).all()


def test_x_stays_below_five_micrometres(behaviour: Behaviour) -> None:
    for um in (behaviour.cold, behaviour.warm, behaviour.after_idle_reduction):
        assert np.abs(um[:, X]).max() < 5.0


def test_heat_is_conserved_when_nothing_is_driven(plant: Plant) -> None:
    off = Drive(spindle_speed_rpm=0, chiller=False, feeding=False, powered=False)
    degc = plant.cold()
    for step in range(100):
        degc = plant.advance(degc, time_s=step * 10.0, duration_s=10.0, drive=off)
    assert np.abs(degc - 20.0).max() < 1e-9


def test_days_differ_by_up_to_a_fifth() -> None:
    first, second = Day.draw(1), Day.draw(2)
    assert first == Day.draw(1)
    for one, other in (
        (first.capacity_factors, second.capacity_factors),
        (first.conductance_factors, second.conductance_factors),
        (first.heat_factors, second.heat_factors),
    ):
        values = np.array([*one.values(), *other.values()])
        assert ((values >= 1 - SPREAD) & (values <= 1 + SPREAD)).all()
        assert values.max() - values.min() > SPREAD
        assert one != other
    ambient = [[Plant(day).ambient.outside_degc(t) for t in range(0, 86400, 3600)] for day in (first, second)]
    assert np.ptp(ambient[0]) > 0.3
    assert ambient[0] != ambient[1]
