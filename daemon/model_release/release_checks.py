"""What a thermal model must fulfil before it is released: by a person, and by the policy alone."""

from collections.abc import Iterator

import numpy as np

from config.schema import Configuration
from daemon.model_release.gate import channels_in_use, training_inhibit, unfit
from models.thermal.family import ThermalModel
from models.thermal.model import CHANNEL_SCORES

DOES_HARM = 1.1
"""A channel of which more than this share of its error remains is worse off than without; noise alone leaves 1.0."""


def gate_inhibit(model: ThermalModel, configuration: Configuration) -> str:
    """Return why a model may not be released, judged by its own figures; '' when it may."""
    return next(_inhibits(model, configuration), "")


def _inhibits(model: ThermalModel, configuration: Configuration) -> Iterator[str]:
    if refused := training_inhibit(model):
        yield refused
    if inhibit := unfit(model, configuration):
        yield inhibit
    scores = model.hyper_parameters.get(CHANNEL_SCORES)
    shares = dict(zip(model.channels, scores, strict=False)) if isinstance(scores, list) else {}
    for channel, widest_um in channels_in_use(configuration).items():
        if (share := shares.get(channel, 0.0)) > DOES_HARM:
            yield (
                f"channel {channel}: {share:.0%} of its error remains on what was left out in training, which is "
                "worse than no compensation; let no axis follow it, or train on more recordings in which it moves"
            )
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
