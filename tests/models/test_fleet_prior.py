"""What a sister takes over: an ordinary model, safe after one recording, whose file the daemon loads."""

from dataclasses import replace

import numpy as np
import pytest
from sisters import few_sensors, sister_recordings

from models.model_file import ModelError
from models.recordings.dataset import Recording
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel
from models.thermal.training.fleet.combination import combination, first_that_counts, taken_over, weighed
from models.thermal.training.fleet.fleet import (
    in_places,
    left_out_machines,
    machine_sample,
    machine_summary,
    machine_type,
    reduced_rows,
)
from models.thermal.training.fleet.machine_type import MachineType, machine_type_from_json
from models.thermal.training.fleet.places import Part, matching, places_of_type
from models.thermal.training.fleet.prior import mean_of_type, prior_recipe
from models.thermal.training.fleet.products import Products, products_of, space_of, summed
from models.thermal.training.inputs import with_sensors
from models.thermal.training.train_family import FamilyTraining, train_family

CREATED = "2026-01-01T00:00:00+00:00"
SENSORS = few_sensors(12)
PARTS = tuple(Part(component=one.component, part=one.part, label=one.label or "") for one in SENSORS)
NAMED = dict(zip((f"T{one.id}" for one in SENSORS), PARTS, strict=True))
CHANNELS = ("Y1", "Y2", "Z1", "Z2", "Z3")


@pytest.fixture(scope="module")
def of_type() -> MachineType:
    places = places_of_type([PARTS] * 3)
    fleet = {f"m{number}": sister_recordings(number, 4, SENSORS, hours=3.0) for number in (1, 2, 3)}
    samples = [machine_sample(name, read, PARTS, places, CHANNELS, 60.0) for name, read in fleet.items()]
    space = space_of(samples)
    summaries = [
        machine_summary(name, read, PARTS, places, CHANNELS, space, tested=True) for name, read in fleet.items()
    ]
    left_out = left_out_machines(summaries)
    return machine_type("mill", CREATED, places, CHANNELS, space, summaries, left_out)


@pytest.fixture(scope="module")
def sister() -> list[Recording]:
    return sister_recordings(9, 6, SENSORS, hours=3.0)


def products(of_type: MachineType, recordings: list[Recording]) -> list[Products]:
    table = matching(of_type.parts, PARTS, "sister")
    found = []
    for recording in in_places(recordings, table, CHANNELS, 60.0):
        inputs, reduced, rows = reduced_rows([recording], of_type.space)
        found.append(products_of(inputs, reduced, rows))
    return found


def training(of_type: MachineType, recordings: list[Recording]) -> FamilyTraining:
    return train_family(recordings, prior_recipe(of_type, NAMED, "sister"), sample_s=60.0, created=CREATED)


def trained(of_type: MachineType, recordings: list[Recording]) -> LinearModel:
    model = training(of_type, recordings).model
    assert isinstance(model, LinearModel)
    return model


def left_um(model: LinearModel, recording: Recording) -> tuple[float, float]:
    minutes = recording.downsampled(60.0)
    degc = with_sensors(minutes, model.sensor_names).temperatures_degc
    estimated_um = model.recorded_um(minutes.time_s / 60.0, degc, minutes.speed_rpm, 0)
    measured_um = minutes.displacements_um - minutes.displacements_um[0]
    left, without = (np.sqrt(np.mean(np.square(um), axis=0)) for um in (measured_um - estimated_um, measured_um))
    return float(left.mean()), float(without.mean())


def test_one_recording_makes_a_model_that_helps_and_that_the_daemon_loads(
    of_type: MachineType, sister: list[Recording]
) -> None:
    model = trained(of_type, sister[:1])
    for unseen in sister[3:]:
        left, without = left_um(model, unseen)
        assert left < 0.5 * without, unseen.name
    loaded = model_from_json(model.to_json(), "model.json")
    assert isinstance(loaded, LinearModel) and loaded.hyper_parameters["taken_over"] == (
        "a combination of the fleet's models"
    )
    online = loaded.runtime(Machine(components={sensor.id: sensor.component for sensor in SENSORS}))
    minutes = sister[3].downsampled(60.0)
    columns = with_sensors(minutes, model.sensor_names).temperatures_degc
    assert minutes.speed_rpm is not None
    times = ((minutes.time_s - minutes.time_s[0]) / 60.0).tolist()
    for at, (now_min, degc) in enumerate(zip(times, columns, strict=True)):
        online.on_sample(now_min, degc, float(minutes.speed_rpm[at]))
        if at == 0:
            online.set_reference(OnlineReference(time_min=now_min, now_min=now_min, degc=degc))
    outcome, _ = online.estimate(times[-1], columns[-1], np.zeros(len(SENSORS), dtype=np.bool_))
    assert outcome is not None
    expected = model.recorded_um(minutes.time_s / 60.0, columns, minutes.speed_rpm, 0)[-1]
    assert np.allclose(outcome.thermal_error_um, expected, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_a_channel_that_is_connected_the_wrong_way_round_takes_over_nothing(
    of_type: MachineType, sister: list[Recording], count: int
) -> None:
    """And is named; the others lose nothing by it that matters."""
    at = CHANNELS.index("Z1")
    sign = np.where(np.arange(len(CHANNELS)) == at, -1.0, 1.0)
    turned = [replace(one, displacements_um=one.displacements_um * sign) for one in sister]
    model = trained(of_type, turned[:count])
    assert "nothing for Z1, whose error that makes larger" in str(model.hyper_parameters["taken_over"])
    for unseen in turned[3:]:
        minutes = unseen.downsampled(60.0)
        columns = with_sensors(minutes, model.sensor_names).temperatures_degc
        estimated_um = model.recorded_um(minutes.time_s / 60.0, columns, minutes.speed_rpm, 0)
        assert np.abs(estimated_um[:, at]).max() < 1e-9
        left, without = left_um(model, unseen)
        assert left < without


def test_the_model_is_the_combination_and_its_domain_and_band_are_not_narrower_than_the_types(
    of_type: MachineType, sister: list[Recording]
) -> None:
    model = trained(of_type, sister[:1])
    table = matching(of_type.parts, PARTS, "sister")
    _, reduced, rows = reduced_rows(in_places(sister[:1], table, CHANNELS, 60.0), of_type.space)
    weights = taken_over(products(of_type, sister[:1]), of_type.models).weights
    expected_um = (reduced[np.flatnonzero(rows)[-1]] - reduced[0]) @ weights
    minutes = sister[0].downsampled(60.0)
    columns = with_sensors(minutes, model.sensor_names).temperatures_degc
    estimated_um = model.recorded_um(minutes.time_s / 60.0, columns, minutes.speed_rpm, 0)
    assert np.allclose(estimated_um[-1], expected_um, atol=1e-3)
    assert (model.band_um >= of_type.band_um[1]).all() and model.watch is None
    assert model.domain.leverage_limit is not None and model.domain.leverage_limit >= of_type.leverage_limit
    to_own = matching(PARTS, of_type.parts, "sister")
    assert (model.domain.highest >= to_own @ of_type.highest_degc - 1e-9).all()


def test_with_nothing_recorded_the_mean_of_the_fleet_is_a_model(of_type: MachineType, sister: list[Recording]) -> None:
    model, trust = mean_of_type(of_type, NAMED, "sister", CREATED)
    table = matching(of_type.parts, PARTS, "sister")
    (read,) = in_places(sister[4:5], table, CHANNELS, 60.0)
    inputs, reduced, rows = reduced_rows([read], of_type.space)
    tested = products_of(inputs, reduced, rows)
    expected = tested.rmse_um(of_type.models.mean(axis=0)) / tested.rmse_um()
    left, without = left_um(model, sister[4])
    assert left / without == pytest.approx(expected.mean(), abs=0.1) and left < 0.7 * without
    assert model.refused is None and trust.held_out_relative_rmse < 0.7
    assert np.array_equal(model.band_um, of_type.band_um[0]) and model.training == ()
    again = model_from_json(model.to_json().encode(), "mean.json")
    assert isinstance(again, LinearModel) and left_um(again, sister[4])[0] == pytest.approx(left, rel=1e-5)


def followed(model: LinearModel, recording: Recording, *, on_at: int) -> float:
    """Return how far the model is followed a quarter of an hour after the daemon began, with a reference at once."""
    online = model.runtime(Machine(components={sensor.id: sensor.component for sensor in SENSORS}))
    minutes = recording.downsampled(60.0)
    degc = with_sensors(minutes, model.sensor_names).temperatures_degc
    assert minutes.speed_rpm is not None
    for at in range(on_at, on_at + 16):
        online.on_sample(float(at), degc[at], float(minutes.speed_rpm[at]))
        if at == on_at:
            online.set_reference(OnlineReference(time_min=float(at), now_min=float(at), degc=degc[at]))
    outcome, _ = online.estimate(float(on_at + 15), degc[on_at + 15], np.zeros(len(SENSORS), dtype=np.bool_))
    assert outcome is not None
    return outcome.confidence


def test_the_mean_is_followed_from_switching_on_and_less_where_the_machine_is_hot_then(
    of_type: MachineType, sister: list[Recording]
) -> None:
    """What a machine at rest adds by its lags the fleet's recordings tell; of one that was stopped hot nobody knows."""
    model, _ = mean_of_type(of_type, NAMED, "sister", CREATED)
    assert min(followed(model, one, on_at=0) for one in sister) > 0.99
    hot = [followed(model, one, on_at=len(one.downsampled(60.0).time_s) - 30) for one in sister]
    assert max(hot) < 0.95, hot
    before, _ = mean_of_type(replace(of_type, start=None), NAMED, "sister", CREATED)  # of a file without it
    assert followed(before, sister[0], on_at=0) < 0.1


def test_the_gate_refuses_the_mean_of_a_fleet_that_does_harm_or_was_never_tried(of_type: MachineType) -> None:
    assert of_type.mean_leaves is not None and of_type.mean_leaves.shape == (3, len(CHANNELS))
    bad = of_type.mean_leaves.copy()
    bad[1] = 1.2
    for leaves, said in ((None, "does not say"), (bad[:2], "does not say"), (bad, "120% of the error remains")):
        model, trust = mean_of_type(replace(of_type, mean_leaves=leaves), NAMED, "sister", CREATED)
        assert model.refused is not None and said in model.refused and trust.refused == model.refused


def test_machines_of_a_few_rows_teach_and_spoil_nothing() -> None:
    """Three of six recorded ten minutes each, fewer rows than sensors, and count by these."""
    places = places_of_type([PARTS] * 3)
    fleet = {f"m{number}": sister_recordings(number, 3, SENSORS, hours=3.0) for number in (1, 2, 3)}
    short = {f"m{number}": sister_recordings(number, 1, SENSORS, hours=0.18) for number in (4, 5, 6)}
    space = space_of([machine_sample(name, read, PARTS, places, CHANNELS, 60.0) for name, read in fleet.items()])
    each = {
        name: machine_summary(name, read, PARTS, places, CHANNELS, space, tested=False)
        for name, read in (fleet | short).items()
    }
    summaries = list(each.values())
    assert [one.products.rows < len(PARTS) for one in summaries] == [False] * 3 + [True] * 3

    unseen = sister_recordings(9, 4, SENSORS, hours=3.0)
    table = matching(places, PARTS, "sister")
    left = []
    for some in (summaries, summaries[:3]):
        of_type = machine_type("mill", CREATED, places, CHANNELS, space, some, [])
        tested = summed(
            products_of(*reduced_rows([one], of_type.space)) for one in in_places(unseen, table, CHANNELS, 60.0)
        )
        left.append(float((tested.rmse_um(of_type.models.mean(axis=0)) / tested.rmse_um()).mean()))
    assert left[0] < 1.25 * left[1], left


def test_a_machine_that_lacks_a_sensor_takes_over_what_the_others_tell(
    of_type: MachineType, sister: list[Recording]
) -> None:
    fewer = [with_sensors(one, [name for at, name in enumerate(one.temperature_names) if at != 4]) for one in sister]
    model = trained(of_type, fewer[:1])
    assert len(model.sensor_ids) == len(SENSORS) - 1
    left, without = left_um(model, fewer[4])
    assert left < 0.6 * without


def test_the_sensors_of_one_machine_may_be_counted_otherwise(of_type: MachineType, sister: list[Recording]) -> None:
    names = sorted(sister[0].temperature_names, key=lambda name: NAMED[name], reverse=True)
    one = trained(of_type, sister[:1])
    other = trained(of_type, [with_sensors(sister[0], names)])
    assert one.sensor_names != other.sensor_names
    places = [other.sensor_names.index(name) for name in one.sensor_names]
    columns = [place + lag * len(SENSORS) for lag in range(1 + len(one.layout.lags_min)) for place in places]
    temperatures = one.layout.temperature_columns
    assert np.allclose(one.coefficients()[:temperatures], other.coefficients()[columns], atol=1e-6)


def test_a_machine_that_moves_as_one_of_the_fleet_is_taken_for_that_one(
    of_type: MachineType, sister: list[Recording]
) -> None:
    (one,) = products(of_type, sister[:1])
    members = of_type.models
    xy = one.xx @ members[1]
    alike = replace(one, xy=xy, yy=(members[1] * xy).sum(axis=0))
    away = [np.linalg.norm(combination([alike], members, pull) - members[1]) for pull in (1e-9, 0.3)]
    assert away[0] < 1e-3 * np.linalg.norm(members[1])
    assert away[0] < away[1] < np.linalg.norm(members.mean(axis=0) - members[1])


def test_what_came_before_a_change_of_the_machine_counts_little(of_type: MachineType, sister: list[Recording]) -> None:
    changed = [
        replace(one, displacements_um=one.displacements_um * (-1.5 if at < 3 else 1.0)) for at, one in enumerate(sister)
    ]
    read = products(of_type, changed)
    assert first_that_counts(products(of_type, sister)) == 0
    assert first_that_counts(read) == 3
    assert [one.yy[0] < 0.1 * other.yy[0] for one, other in zip(weighed(read), read, strict=True)] == [True] * 3 + [
        False
    ] * 3
    kept, all_alike = (taken_over(some, of_type.models).weights for some in (weighed(read), read))
    later = products(of_type, sister_recordings(9, 3, SENSORS, hours=3.0, first=6))
    assert sum(one.left_um2(kept).sum() for one in later) < sum(one.left_um2(all_alike).sum() for one in later)


def test_a_type_comes_back_from_its_file_and_a_changed_file_is_refused(of_type: MachineType) -> None:
    text = of_type.to_json().encode()
    again = machine_type_from_json(text, "type.json")
    assert np.allclose(again.models, of_type.models) and again.parts == of_type.parts
    with pytest.raises(ModelError, match=r"type.json: sha256: does not fit"):
        machine_type_from_json(text.replace(b'"type_id": "mill"', b'"type_id": "milk"'), "type.json")
    with pytest.raises(ModelError, match="not a type of machine; `toolpoint fleet train -o` writes one"):
        machine_type_from_json(b"{}", "type.json")
    with pytest.raises(ModelError, match="family"):
        model_from_json(text, "type.json")
