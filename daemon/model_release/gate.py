"""What a thermal model must fulfil before it is followed."""

from collections.abc import Mapping
from hashlib import sha256

from config.records.release_record import ReleaseRecord
from config.schema import Configuration
from config.schema.cnc import SPEED
from models.thermal.family import ThermalModel
from models.thermal.model import MACHINE, READS


def channels_in_use(configuration: Configuration) -> dict[str, float]:
    """Return the channels that axes follow, each with the widest band that its model may have [um]."""
    widest: dict[str, float] = {}
    for axis in configuration.compensation.axes.values():
        if axis.estimate is not None:
            limit_um = configuration.compensation.release.largest_band_um or axis.absolute_bound_um
            widest[axis.estimate] = min(limit_um, widest.get(axis.estimate, limit_um))
    return widest


def training_inhibit(model: ThermalModel) -> str:
    """Return why a model's own training refused it, '' when it did not, or could not tell."""
    if model.refused is not None:
        return f"its training refused it: {model.refused}"
    return ""


def machine_inhibit(model: ThermalModel, configuration: Configuration, said: str = "") -> str:
    """Return that a model was trained on another machine than this or than a person has `said`, '' when it was not."""
    trained_on = model.hyper_parameters.get(MACHINE, "")
    if trained_on in ("", configuration.machine, said):
        return ""
    return (
        f"it was trained on machine {trained_on!r}, and this one is {configuration.machine!r} (machine); where it "
        f"serves this one too, release it with --trained-on {trained_on!r}"
    )


def inputs_now(configuration: Configuration) -> dict[str, str]:
    """Return what every sensor reads, and the sensors of every label, by what a model's release calls them."""
    reads = [*configuration.temperatures.reads.items()]
    labels = configuration.temperatures.labels.items()
    of_labels = {f"label {label}": " ".join(sorted(reads[place][1] for place in places)) for label, places in labels}
    return {f"sensor {sensor_id}": read for sensor_id, read in reads} | of_labels | configuration.cnc.reads


def inputs_of(model: ThermalModel) -> list[str]:
    """Return what `inputs_now` calls the inputs of a model."""
    places = [f"axis position {name}" for name in model.axis_positions]
    sensors = [f"sensor {sensor_id}" for sensor_id in model.sensor_ids[: len(model.sensor_ids) - len(places)]]
    return [*sensors, *places, *([SPEED] if model.needs_speed else [])]


def inputs_inhibit(record: ReleaseRecord | None, configuration: Configuration) -> str:
    """Return that inputs of a model read something else than when it was released, '' when none does."""
    then, now = {} if record is None else record.reads, inputs_now(configuration)
    if not (other := [name for name, read in then.items() if now.get(name) != read]):
        return ""
    return (
        f"{', '.join(other[:8])} read something else than when it was released (see temperatures, cnc); where they "
        "still measure what it was trained on, release it again from its file"
    )


def reads_in_short(model: ThermalModel, reads: Mapping[str, str]) -> str:
    """Return in one word what a model's inputs and what it was fitted to read; `reads`: of each, by its name."""
    names = [*inputs_of(model), *(f"displacement {channel}" for channel in model.channels)]
    return sha256(" ".join(reads.get(each, "") for each in names).encode()).hexdigest()[:16]


def read_otherwise(model: ThermalModel, configuration: Configuration) -> str:
    """Return that a model's sensors read something else than in its training, '' when not, or when nobody knows."""
    sensors = {f"sensor {sensor_id}": read for sensor_id, read in configuration.reads.items()}
    now = reads_in_short(model, sensors | configuration.other_reads)
    if model.hyper_parameters.get(READS, now) == now:
        return ""
    return "its inputs read something else than when it was trained (see temperatures, cnc, displacements)"


def unfit(model: ThermalModel, configuration: Configuration) -> str:
    """Return why a model does not fit what the control gives and the axes that take it, '' when it does."""
    if model.needs_speed and not configuration.cnc.connection.reads_speed:
        return (
            "it estimates from spindle speed, which is not read from this control: name its variable under "
            "cnc.opcua.nodes.spindle_speed (see `toolpoint cnc probe`), or take speed out of the map and train it again"
        )
    for name, axis in configuration.compensation.axes.items():
        if axis.estimate is None or axis.estimate not in model.channels:
            continue
        key, pivot_mm = f"compensation.axes.{name}.estimate", model.pivots_mm.get(axis.estimate)
        if axis.slope is None and pivot_mm is not None:
            return (
                f"channel {axis.estimate} is a slope along an axis [um/m], and axis {name} takes an offset; "
                f"name the channel of the offset ({key})"
            )
        if axis.slope is not None and pivot_mm is None:
            return f"channel {axis.estimate} is no slope along an axis, and {name} is one; name the slope's ({key})"
        if axis.slope is not None and pivot_mm != axis.slope.pivot_mm:
            return (
                f"channel {axis.estimate} is a slope about {pivot_mm:g} mm, and {name} about "
                f"{axis.slope.pivot_mm:g} mm (compensation.axes.{name}.slope.pivot_mm): train with that pivot"
            )
    return ""
