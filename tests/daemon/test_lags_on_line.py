"""A model with lags in the daemon: states filled from the history, doubted until then, continuous over a restart."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import structlog
from control_rig import SENSOR_IDS, machine
from lag_shop import PAST_MIN, Shop, day, trained
from thermal_rig import model as increments
from whole_loop import lagged_model

from config.schema.cnc import SPEED
from config.schema.cnc_drivers import NO_NODE, OpcUaNodesConfig
from daemon.messages import ReferenceEnded, SensorsSinceReference
from daemon.model_release.gate import inputs_now, inputs_of, unfit
from daemon.model_release.release_checks import gate_inhibit
from daemon.simulation.replaying import not_enabled
from daemon.state_store.store import StateStore
from models.control.reference_records import ReferenceDocument, ReferenceRecord, ReferenceState
from models.records import Reference, ThermalErrorEstimate
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.features import Layout
from models.thermal.training.recipes import RECIPES
from models.thermal.training.ridge_member import DEPARTURES, RidgeFamily


@pytest.fixture(scope="module")
def model():
    """A ridge whose longest lag is an hour, whatever training would choose: a past of four hours fills it."""
    lags_min = (2.0, 5.0, 10.0, 30.0, PAST_MIN / 4.0)
    prepare = partial(RidgeFamily, design=DEPARTURES)
    return trained(day(minutes=300, seed=1), replace(RECIPES["lags"], prepare=prepare, needed_lags_min=(lags_min, ())))


@pytest.fixture(scope="module")
def model_with_speed():
    made = trained(day(seed=1, by_load=True))
    assert made.layout.speed_lags_min
    return made


@pytest.fixture(scope="module")
def watched_without_lags(model):
    """As the default family makes one where lags do not help: the watch has lags all the same."""
    made = replace(trained(day(minutes=300, seed=1), "ridge"), watch=model.watch)
    assert made.watch is not None and not made.layout.lags_min
    return made


def with_nodes(configuration, **opcua):
    section = configuration.cnc.opcua.model_copy(update=opcua)
    return configuration.model_copy(update={"cnc": configuration.cnc.model_copy(update={"opcua": section})})


def test_a_model_with_speed_is_not_released_where_no_speed_is_read(tmp_path, model, model_with_speed):
    reads = machine(tmp_path)
    for mute in (with_nodes(reads, preset="generic"), with_nodes(reads, nodes=OpcUaNodesConfig(spindle_speed=NO_NODE))):
        why = unfit(model_with_speed, mute)
        assert "spindle speed, which is not read from this control" in why and "nodes.spindle_speed" in why
        assert gate_inhibit(replace(model_with_speed, refused=None), mute) == why
        assert unfit(model, mute) == ""
    for speaks in (reads, with_nodes(reads, preset="generic", nodes=OpcUaNodesConfig(spindle_speed="s=Speed"))):
        assert unfit(model_with_speed, speaks) == ""


def test_speed_is_an_input_of_a_model_that_needs_it(tmp_path, model, model_with_speed):
    assert [SPEED in inputs_of(each) for each in (model, model_with_speed)] == [False, True]
    assert SPEED in inputs_now(machine(tmp_path))


async def test_a_machine_that_was_off_over_night_is_followed_from_its_first_reference(tmp_path, model_with_speed):
    shop = Shop(tmp_path, model_with_speed, by_load=True, step_s=30.0)
    await shop.prepare()
    await shop.run(2)
    assert shop.task.inhibit() == "", "it stands as it stood when its recording began"
    await shop.refer()
    await shop.run(2)
    assert shop.latest.confidence > 0.9
    await shop.end()


@pytest.mark.parametrize("behind_s", [0.0, 1e6])
async def test_an_edited_configuration_leaves_nothing_of_another_variable_in_the_lags_of_speed(
    tmp_path, model_with_speed, behind_s
):
    """For five hours a variable in place of the speed said a fifth of it; then a person named the right one.

    `behind_s`: a computer without a clock of its own begins where its calendar stood, until a time server answers.
    """
    found = []
    for share in (1.0, 0.2):
        (folder := tmp_path / str(share)).mkdir()
        shop = Shop(folder, model_with_speed, by_load=True)
        await shop.end()
        right, rpm = shop.configuration, shop.rpm
        for edit, said in ((share < 1.0, share * rpm), (False, rpm), (False, rpm)):
            shop.configuration = with_nodes(right, nodes=OpcUaNodesConfig(spindle_speed="s=Load")) if edit else right
            shop.rpm = said
            started_anew(shop, 1.0, behind_s)
            await shop.prepare()
            await shop.run(2)
            shop.clock.calendar_s += behind_s
            await shop.run(300 if said is not rpm or shop.minute < 1.0 else 4)
            await shop.refer()
            await shop.run(30)
            await shop.end()
        found.append(shop.latest)
    twin, after = found
    assert twin.confidence > 0.9
    off_um = np.abs(after.thermal_error_um - twin.thermal_error_um).max()
    assert after.confidence < 0.3, f"{off_um:.1f} um off, with a confidence of {after.confidence}"
    assert "spindle speed" in after.inhibit


async def test_a_warm_machine_without_a_past_is_doubted_says_what_it_needs_and_has_a_wider_band(
    tmp_path, model_with_speed
):
    shop = Shop(tmp_path, model_with_speed, by_load=True, step_s=30.0)
    shop.degc, shop.rpm, _ = day(seed=1, by_load=True)
    shop.minute = 75.0
    await shop.prepare()
    await shop.run(2)
    await shop.refer()
    await shop.run(60)
    early = shop.latest
    assert early.confidence < 0.7
    assert "the last 16.0 h of temperatures and spindle speed" in early.inhibit
    refusal = f"the daemon refused to enable: {early.inhibit}"
    in_a_replay = not_enabled(refusal, arrived=8, played=10.0)
    for arrived, of_ten in ((0, "none arrived"), (4, "of 10 cycles of temperatures 4 arrived")):
        busy = not_enabled(refusal, arrived=arrived, played=10.0)
        assert of_ten in busy and "smaller --speed" in busy and "--from-hours" not in busy, "not the recording's fault"
    assert "begin the replay where the machine has stood still" in in_a_replay and "; wait" not in in_a_replay
    assert shop.task.inhibit() == early.inhibit
    assert early.band_um > 1.2 * model_with_speed.band_um
    await shop.run(12 * 60)
    assert shop.task.inhibit() == ""
    await shop.refer()
    await shop.run(60)
    assert shop.latest.band_um < early.band_um
    await shop.end()


async def test_an_outage_of_half_an_hour_is_bridged(tmp_path, model):
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    reference = await shop.refer()
    await shop.run(30)
    await shop.end()
    shop.clock.monotonic_s += 1800.0
    shop.minute += 30.0
    shop.begin()
    await shop.prepare()
    await shop.task._take(shop.taken_up(reference))
    await shop.run(30)
    assert shop.task.inhibit() == "" and shop.latest.confidence > 0.9
    truth = day(seed=7)[2][int(shop.minute), 0] - day(seed=7)[2][int(shop.minute) - 90, 0]
    assert abs(shop.latest.thermal_error_um[0] - truth) < 3.0
    await shop.end()


async def test_a_restart_goes_on_as_if_it_had_never_been_away(tmp_path, model):
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    assert shop.task.inhibit() == ""
    reference = await shop.refer()
    await shop.run(60)
    before = shop.latest.thermal_error_um.copy()
    assert shop.latest.confidence > 0.9 and np.abs(before).max() > 1.0
    await shop.end()

    shop.begin()
    await shop.prepare()
    assert shop.task.inhibit() == "", "the history is long enough"
    await shop.task._take(shop.taken_up(reference))
    await shop.run(1)
    assert shop.latest.thermal_error_um == pytest.approx(before, abs=0.3)
    assert shop.latest.confidence > 0.9
    await shop.end()


async def with_a_sensor_excluded(tmp_path, model):
    """A shop in whose history the watch has found the first sensor wrong, and the reference since which it is out."""
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    reference = await shop.refer()
    await shop.run(10)
    row = int(shop.minute)
    shop.degc[row + 1 :, 0] += np.minimum(np.arange(len(shop.degc) - row - 1) * 0.3, 6.0)
    await shop.run(40)
    assert shop.latest.imputed == (1,)
    return shop, reference


async def test_a_sensor_that_was_excluded_stays_out_over_a_restart_and_a_reload_until_a_new_reference(tmp_path, model):
    shop, reference = await with_a_sensor_excluded(tmp_path, model)
    before, confidence = shop.latest.thermal_error_um.copy(), shop.latest.confidence

    await shop.history.flushed()
    await shop.task.use_model(replace(model, model_id="loaded anew"))
    await shop.run(1)
    assert (shop.latest.model_id, shop.latest.imputed) == ("loaded anew", (1,))
    assert shop.latest.thermal_error_um == pytest.approx(before, abs=1.5)
    await shop.end()

    shop.begin()
    await shop.prepare()
    await shop.task._take(shop.taken_up(reference))
    await shop.run(1)
    assert shop.latest.imputed == (1,)
    assert shop.latest.confidence == pytest.approx(confidence, abs=0.05)
    assert shop.latest.thermal_error_um == pytest.approx(before, abs=1.5)

    await shop.refer()
    assert shop.latest.imputed == (), "a new reference admits every sensor"
    await shop.end()


async def test_a_watch_alone_goes_on_from_the_history_after_a_restart(tmp_path, watched_without_lags):
    """It began anew, in a machine that warms up: healthy sensors did not count for the rest of the reference."""
    shop = Shop(tmp_path, watched_without_lags)
    await shop.prepare()
    for hours in (2, 3, 8):
        await shop.run(max(0.0, 63 * hours - shop.minute))
        reference = await shop.refer()
        await shop.run(5)
        await shop.end()

        shop.begin()
        await shop.prepare()
        assert shop.task.inhibit() == "", "a model without lags waits for no history"
        await shop.task._take(shop.taken_up(reference))
        for minute in range(58):
            await shop.run(1)
            assert shop.latest.imputed == (), (hours, minute)
    await shop.end()


async def test_where_too_much_rests_on_sensors_that_were_found_wrong_the_output_holds_until_a_new_reference(
    tmp_path, model
):
    """They may be right again: half of the estimate was followed until then, 9 um beside the truth."""
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    await shop.refer()
    await shop.run(10)
    for sensor in (1, 4):
        row = int(shop.minute)
        shop.degc[row + 1 :, sensor] += np.minimum(np.arange(len(shop.degc) - row - 1) * 0.3, 6.0)
        await shop.run(30)
    assert shop.latest.imputed == (2, 12) and shop.latest.confidence == 0.0
    assert "too much rests on sensor 2, sensor 12, found wrong" in shop.latest.inhibit

    await shop.refer()
    assert shop.latest.confidence > 0.9 and shop.latest.inhibit == ""
    await shop.end()


async def test_a_sensor_that_returns_counts_again_without_a_step_over_a_restart_too(tmp_path, model):
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 45)
    reference = await shop.refer()
    await shop.run(10)
    shop.degc[int(shop.minute) + 1 : int(shop.minute) + 6, 0] = np.nan
    shop.degc[int(shop.minute) + 6 :, 0] += 8.0
    await shop.run(5)
    gone = shop.latest
    assert gone.imputed == (1,) and gone.confidence > 0.7
    first = len(shop.delivered) - 1
    await shop.run(6)
    assert shop.latest.imputed == ()
    levels = shop.task._cleansing.levels
    wrong_k, doubt_k = levels.shift_k[0] - 8.0, levels.uncertainty_k[0]
    assert 0.0 < abs(wrong_k) <= doubt_k < 1.0, "by so much it may stand elsewhere, which is worth less than 1 um"
    assert shop.latest.confidence > 0.9
    errors = [e.thermal_error_um for e in shop.delivered[first:] if isinstance(e, ThermalErrorEstimate)]
    assert np.abs(np.diff(errors, axis=0)).max() < 0.7, "no step, but what half a minute of cooling and fading makes"
    assert shop.task.inhibit() == "", "one silent sensor does not empty the states"
    await shop.run(1)
    earlier = shop.latest.thermal_error_um
    await shop.run(1)  # some minutes later the watch, which looks at every sensor anew, blames it
    before = shop.latest
    assert before.imputed == ()
    await shop.end()

    shop.begin()
    await shop.prepare()
    await shop.task._take(shop.taken_up(reference))
    await shop.run(1)
    assert shop.latest.imputed == () and shop.latest.confidence == pytest.approx(before.confidence, abs=0.05)
    goes_on_um = 2.0 * before.thermal_error_um - earlier
    assert shop.latest.thermal_error_um == pytest.approx(goes_on_um, abs=0.3)
    shop.degc[int(shop.minute) :, 0] = np.nan
    await shop.run(3)
    assert shop.latest.imputed == (1,)
    await shop.end()


@pytest.mark.parametrize("offset_k", [0.0, 2.5])
async def test_a_sensor_that_returns_within_what_its_past_explains_counts_as_before_or_is_doubted(
    tmp_path, model, offset_k
):
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    await shop.refer()
    await shop.run(10)
    shop.degc[int(shop.minute) + 1 : int(shop.minute) + 5, 0] = np.nan
    shop.degc[int(shop.minute) + 5 :, 0] += offset_k
    await shop.run(10)
    assert shop.latest.imputed == ()
    if offset_k:
        assert shop.latest.confidence == 0.0 and "sensor 1 by" in shop.latest.inhibit
    else:
        assert shop.latest.confidence > 0.9 and shop.latest.inhibit == ""
    await shop.end()


@pytest.mark.parametrize(("minutes", "held"), [(0, False), (8, True), (25, True)])
async def test_a_spindle_that_began_to_turn_while_its_speed_was_not_read_holds_the_output(
    tmp_path, model_with_speed, minutes, held
):
    """The lags went straight from one speed to the other, and the tool stood up to 8 um wrong in ACTIVE for an hour."""
    shop = Shop(tmp_path, model_with_speed, by_load=True)
    await shop.prepare()
    await shop.run(20)
    await shop.refer()
    await shop.run(10)
    await shop.run(minutes, speed=False)
    await shop.run(3)
    assert ("spindle speed was not read" in shop.latest.inhibit) is held
    assert (shop.latest.confidence == 0.0) is held
    await shop.refer()
    await shop.run(10)
    assert ("shortly before" in shop.latest.inhibit) is held, "what was positioned meanwhile counts the same lags"
    await shop.run(110)
    await shop.refer()
    await shop.run(10)
    assert shop.latest.inhibit == "" and shop.latest.confidence > 0.9, "it has faded"
    await shop.end()


@pytest.mark.parametrize("gives_speed", [True, False])
async def test_a_control_that_gives_no_spindle_speed_is_named_and_nobody_is_told_to_wait(
    tmp_path, model_with_speed, gives_speed
):
    shop = Shop(tmp_path, model_with_speed, by_load=True)
    shop.degc = shop.degc + np.linspace(0.0, 8.0, shop.degc.shape[1])  # not as at the beginning of training
    await shop.prepare()
    await shop.run(20, speed=gives_speed)
    said = shop.task.inhibit()
    assert "of temperatures and spindle speed, of which too little is known" in said
    assert ("wait, and leave the daemon running" in said) is gives_speed
    assert ("the control gives no spindle speed" in said) is not gives_speed
    await shop.end()


def far_back(shop):
    """Return the means of the past hours, in the clock that does not jump."""
    now_s = shop.clock.now().monotonic_s
    means = shop.task._past.means(now_s - 36000.0, now_s, 60.0)
    return np.array([(time_s, *row) for time_s, row, _ in means])


async def test_the_past_is_read_again_when_a_calendar_that_was_wrong_at_the_start_is_set_right(tmp_path, model):
    """A computer without a clock of its own begins where its calendar stood, until a time server answers."""
    shops = []
    for behind_min in (0.0, 29.0, 400.0, -600.0):
        (tmp_path / f"{behind_min:g}").mkdir()
        shop = Shop(tmp_path / f"{behind_min:g}", model)
        await shop.prepare()
        await shop.run(150)
        await shop.end()
        shop.clock.monotonic_s += 1800.0
        shop.minute += 30.0
        shop.clock.calendar_s -= 60.0 * behind_min
        shop.begin()
        await shop.prepare()
        await shop.run(3)
        shop.clock.calendar_s += 60.0 * behind_min
        await shop.run(2)
        await shop.history.flushed()
        shops.append((shop, far_back(shop)))
        await shop.refer()
        await shop.run(60)
        await shop.end()
    (twin, right), *others = shops
    for shop, again in others:
        np.testing.assert_allclose(again[:-6], right[:-6], equal_nan=True)
        assert np.isfinite(again[:, 1]).sum() == pytest.approx(155, abs=3)
        assert shop.latest.confidence == pytest.approx(twin.latest.confidence, abs=0.02)
        np.testing.assert_allclose(shop.latest.thermal_error_um, twin.latest.thermal_error_um, atol=1.0)


async def restarted(shop, minutes):
    """The daemon starts again on the same computer, after so many minutes."""
    await shop.end()
    shop.clock.monotonic_s += 60.0 * minutes
    shop.minute += minutes
    shop.begin()
    await shop.prepare()


async def test_a_calendar_that_is_set_wrong_while_the_daemon_runs_moves_nothing(tmp_path, model):
    """What the daemon before had recorded was read again, hours off: the order is known by the other clock."""
    shops = []
    for set_by_s in (0.0, -10800.0, 10800.0):
        (tmp_path / f"{set_by_s:g}").mkdir()
        shop = Shop(tmp_path / f"{set_by_s:g}", model)
        await shop.prepare()
        await shop.run(2 * 60)
        await restarted(shop, 5)
        await shop.run(10)
        shop.clock.calendar_s += set_by_s
        await shop.run(2)
        await shop.history.flushed()
        past = far_back(shop)
        await restarted(shop, 5)
        await shop.run(2)
        await shop.refer()
        await shop.run(30)
        shops.append((shop, past, far_back(shop)))
        await shop.end()
    (twin, *right), *others = shops
    for shop, *again in others:
        for was, of_twin in zip(again, right, strict=True):
            np.testing.assert_allclose(was[:-6], of_twin[:-6], equal_nan=True)
        assert shop.latest.confidence == pytest.approx(twin.latest.confidence, abs=0.02)
        np.testing.assert_allclose(shop.latest.thermal_error_um, twin.latest.thermal_error_um, atol=0.3)


async def test_of_before_the_computer_s_start_nothing_is_known_once_the_calendar_was_set_long_after_it(tmp_path, model):
    """Which of the two calendars was right nobody knows; one that is set at once was wrong until then."""
    shop = Shop(tmp_path, model)
    await shop.prepare()
    await shop.run(120)
    await shop.end()
    started_anew(shop)
    await shop.prepare()
    known = []
    for minutes, set_by_s in ((5, 0.0), (0, 3600.0), (20, -1800.0), (2, 1800.0)):
        await shop.run(minutes)
        shop.clock.calendar_s += set_by_s
        await shop.run(1)
        await shop.history.flushed()
        known.append(int(np.isfinite(far_back(shop)[:-40, 1]).sum()))
    before, soon, unsure, again = known
    assert before == again == pytest.approx(120, abs=3) and soon == pytest.approx(120, abs=3)
    assert unsure == 0
    await shop.end()


def started_anew(shop, minutes=40.0, behind_s=0.0):
    """The computer is switched off and on again after so many minutes, and its other clock begins anew."""
    utc_s = shop.clock.now().utc_s + 60.0 * minutes - behind_s
    shop.clock.monotonic_s = 100.0
    shop.clock.calendar_s = utc_s - 100.0
    shop.minute += minutes
    shop.begin()


async def test_a_model_that_waits_reads_the_past_again_when_the_calendar_is_set(tmp_path, model):
    """The one in use has no lags, and nothing of its past to read again."""
    shop = Shop(tmp_path, increments())
    await shop.prepare()
    await shop.run(60)
    await shop.end()
    started_anew(shop, 10.0)
    shop.clock.calendar_s -= 24000.0
    await shop.prepare()
    await shop.run(3)
    await shop.refer()
    with structlog.testing.capture_logs() as logs:
        await shop.task.use_model(model)
        shop.clock.calendar_s += 24000.0
        await shop.run(2)
    assert shop.latest.model_id == model.model_id
    read = [entry["known_h"] for entry in logs if entry["event"] == "states.rebuilt"]
    assert read[0] < 0.1 and read[-1] > 0.9
    await shop.end()


async def stand_alike(shops: list[Shop], *, within_um: float) -> None:
    """Of a twin and another one the estimates agree and count; both end."""
    twin, loop = (shop.latest for shop in shops)
    assert loop.confidence > 0.9
    np.testing.assert_allclose(loop.thermal_error_um, twin.thermal_error_um, atol=within_um)
    for shop in shops:
        await shop.end()


async def test_a_reference_that_was_never_left_is_not_made_anew_from_the_history(tmp_path, model):
    """By hand another one was asked for and refused: with the states of now at it, what had warmed since was lost."""
    shops = []
    for name in ("twin", "refused"):
        (tmp_path / name).mkdir()
        shop = Shop(tmp_path / name, model)
        await shop.prepare()
        await shop.run(PAST_MIN + 20)
        reference = await shop.refer()
        shop.sensors = next(item for item in reversed(shop.delivered) if isinstance(item, SensorsSinceReference))
        await shop.run(1)
        if name == "refused":
            await shop.task._take(shop.taken_up(reference))
        await shop.run(10)
        shops.append(shop)
    await stand_alike(shops, within_um=0.05)


async def test_a_reference_of_a_minute_before_a_restart_is_taken_up_with_the_states_of_then(tmp_path, model):
    """With those of now the lags would lose what had warmed in that minute: 1.5 um."""
    shops = []
    for name in ("twin", "restarted"):
        (tmp_path / name).mkdir()
        shop = Shop(tmp_path / name, model, step_s=20.0)
        await shop.prepare()
        await shop.run(PAST_MIN + 26)
        reference = await shop.refer()
        shop.sensors = next(item for item in reversed(shop.delivered) if isinstance(item, SensorsSinceReference))
        await shop.run(1)
        if name == "restarted":
            taken_up = shop.taken_up(reference)
            await shop.end()
            shop.begin()
            await shop.prepare()
            await shop.task._take(taken_up)
        await shop.run(10)
        shops.append(shop)
    await stand_alike(shops, within_um=0.3)


def speed_alone():
    lagless = lagged_model("speed alone")
    layout = Layout(sensors=len(SENSOR_IDS), lags_min=(), speed_lags_min=(30.0,))
    columns = layout.columns
    solution = replace(
        lagless.solutions[0],
        layout=layout,
        gain=np.ones(columns),
        weights=np.ones((columns, 2)),
        directions=np.eye(columns),
        remaining=np.linspace(0.02, 1.0, columns),
    )
    vector = replace(
        lagless.test_vectors[0],
        features=np.ones(columns),
        reference=np.zeros(columns),
        thermal_error_um=np.full(2, float(columns)),
    )
    return replace(lagless, layout=layout, solutions=(solution,), centre=np.zeros(columns), test_vectors=(vector,))


def test_a_model_with_lags_of_speed_alone_takes_up_again_what_a_sensor_that_returned_counts_from():
    """What lags were shifted by is nothing there, and was of another shape in the store: the restart met a defect."""
    made = speed_alone()
    degc = day(minutes=90, seed=7)[0]
    away = degc[:90].copy()
    away[30:75, 1] = np.nan

    def begun(minutes):
        online = made.runtime(Machine(components={}))
        online.rebuild((float(minute), away[minute], 0.0) for minute in range(minutes))
        return online

    online, absent = begun(40), np.zeros(len(SENSOR_IDS), dtype=bool)
    online.set_reference(OnlineReference(time_min=39.0, now_min=39.0, degc=away[39]))
    for minute in range(40, 80):
        online.on_sample(float(minute), away[minute], 0.0)
        found, _ = online.estimate(float(minute), away[minute], absent)
        absent = np.isin(SENSOR_IDS, found.imputed)
    kept = json.loads(json.dumps(online.kept))
    again, past = begun(80), ((float(minute), away[minute], 0.0) for minute in range(40))
    again.set_reference(
        OnlineReference(time_min=39.0, now_min=79.0, degc=away[39], history=past, excluded={}, kept=kept)
    )
    resumed, _ = again.estimate(79.0, away[79], absent)
    assert kept["reference_degc"] and resumed.imputed == found.imputed
    np.testing.assert_allclose(resumed.thermal_error_um, found.thermal_error_um, atol=0.1)


async def drifted_and_back(tmp_path, model, wrong):
    """A shop in which the first sensor drifted by 6 K and went back in half an hour, since the work was positioned."""
    (folder := tmp_path / str(wrong)).mkdir()
    shop = Shop(folder, model)
    await shop.prepare()
    await shop.run(PAST_MIN + 20)
    await shop.refer()
    drift_k = np.interp(np.arange(len(shop.degc)) - shop.minute, [0.0, 60.0, 90.0], [0.0, 6.0, 0.0])
    shop.degc[:, 0] += wrong * drift_k
    await shop.run(95)
    return shop


async def positioned_again(shop):
    await shop.refer()
    await shop.run(2)
    await shop.history.flushed()


@pytest.mark.parametrize("watched", [True, False])
async def test_a_model_that_is_released_after_a_sensor_was_wrong_counts_it_from_the_next_positioning_on(
    tmp_path, model, watched
):
    """The history tells how it drifted by 6 K; the lags of the model in use were set right, not another's: 0.4 um."""
    lags, off_um = [], []
    for wrong in (False, True):
        await positioned_again(shop := await drifted_and_back(tmp_path, model, wrong))
        await shop.task.use_model(replace(model, model_id="released", watch=model.watch if watched else None))
        await shop.run(3)
        off_um.append(shop.latest.thermal_error_um)
        assert (shop.latest.model_id, shop.latest.imputed) == ("released", (1,) * wrong)
        shop.clock.monotonic_s += 7.0
        await shop.refer()
        await shop.run(1)
        assert shop.latest.imputed == ()
        lags.append(shop.task._online._online._state.lagged[:, 0])
        await shop.end()
    assert off_um[1] == pytest.approx(off_um[0], abs=0.1)
    assert lags[1] == pytest.approx(lags[0], abs=0.1)


async def ended_for_good(shop):
    """The reference ends for good: no record of it is left in the store."""
    await shop.task._take(ReferenceEnded(reference_id="r1", for_good=True))
    await shop.run(1)
    keep_of_reference(shop, ReferenceDocument(state=ReferenceState.NONE))


async def restarted_twice(shop):
    """The first restart takes the reference not up, and leaves no record of it either."""
    reference = next(item for item in reversed(shop.delivered) if isinstance(item, Reference))
    sensors = next(item for item in reversed(shop.delivered) if isinstance(item, SensorsSinceReference))
    record = ReferenceRecord(reference=reference, sensors=sensors)
    keep_of_reference(shop, ReferenceDocument(state=ReferenceState.VALID, record=record))
    await shop.end()
    shop.begin()
    await shop.prepare()
    await shop.run(1)
    keep_of_reference(shop, ReferenceDocument(state=ReferenceState.NONE))


def keep_of_reference(shop, document):
    StateStore(shop.history, shop.clock).put(document)


@pytest.mark.parametrize("before", [positioned_again, restarted_twice, ended_for_good])
async def test_nor_does_a_restart_that_takes_no_reference_up_read_into_the_lags_what_it_said(tmp_path, model, before):
    """Half an hour after the work was positioned again: 1.2 um without a watch, which found it wrong once more.

    So where no record of the reference was left any more, which alone held what had been found wrong since.
    """
    lags, off_um = [], []
    for wrong in (False, True):
        shop = await drifted_and_back(tmp_path, model, wrong)
        await before(shop)
        await shop.end()
        shop.model = replace(model, watch=None)
        shop.begin()
        await shop.prepare()
        await shop.run(1)
        await shop.refer()
        await shop.run(30)
        assert shop.latest.imputed == ()
        off_um.append(shop.latest.thermal_error_um)
        lags.append(shop.task._online._online._state.lagged[:, 0])
        await shop.end()
    assert off_um[1] == pytest.approx(off_um[0], abs=0.1)
    assert lags[1] == pytest.approx(lags[0], abs=0.1)
