"""What a thermal model must fulfil before it is released."""

from collections.abc import Iterator

import numpy as np

from config.schema import Configuration
from models.thermal.family import ThermalModel


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


def slope_inhibit(model: ThermalModel, configuration: Configuration) -> str:
    """Return why a model's slopes do not fit the axes that take them, '' when they do."""
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


def gate_inhibit(model: ThermalModel, configuration: Configuration) -> str:
    """Return why a model may not be released, judged by its own figures; '' when it may."""
    return next(_inhibits(model, configuration), "")


def _inhibits(model: ThermalModel, configuration: Configuration) -> Iterator[str]:
    if refused := training_inhibit(model):
        yield refused
    if unfit := slope_inhibit(model, configuration):
        yield unfit
    for channel, widest_um in channels_in_use(configuration).items():
        band_um = float(model.band_um[model.channels.index(channel)])
        if np.isnan(band_um):
            yield (
                f"channel {channel}: nothing was held out when the model was trained, so how good it is is unknown; "
                "train it on more recordings"
            )
        elif band_um > widest_um:
            unit = "um/m" if channel in model.pivots_mm else "um"
            yield (
                f"channel {channel}: its prediction band of {band_um:.3g} {unit} is wider than {widest_um:g} {unit}; "
                "train it on better recordings, or widen compensation.release.largest_band_um"
            )


def policy_inhibit(model: ThermalModel, active: ThermalModel | None, configuration: Configuration) -> str:
    """Return why a model may not be released without a person, '' when the policy lets it."""
    if not configuration.compensation.release.automatic:
        return (
            "compensation.release.automatic is false, so only a person releases a model: `toolpoint model release FILE`"
        )
    if active is None:
        return "no model is active; the first one is released by a person"
    for channel in channels_in_use(configuration):
        if channel not in active.channels:
            return f"the active model has no channel {channel} to compare with; a person must release this one"
        new_um = float(model.band_um[model.channels.index(channel)])
        old_um = float(active.band_um[active.channels.index(channel)])
        if not new_um <= old_um:
            return (
                f"channel {channel}: its prediction band of {new_um:.3g} um is wider than the active model's "
                f"{old_um:.3g} um; a person must release it"
            )
    return ""
