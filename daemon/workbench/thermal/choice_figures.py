"""What a training chose and what else it tried, channel by channel, for JSON."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from models.json_values import finite_or_none
from models.thermal.training.choice import Candidate, Choice, ChosenProblem
from models.thermal.training.prepared import Prepared
from models.thermal.training.trust import Trust


def choice_of(model: str, prepared: Prepared, trust: Trust) -> Choice:
    """Return what a training chose; of a family that was asked for by name, what it leaves of what was left out."""
    if isinstance(prepared.problem, ChosenProblem):
        return prepared.problem.choice
    held_out, rmse_um, reduction = trust.held_out, (), ()
    if held_out is not None:
        without = np.where(held_out.rmse_without_um > 0.0, held_out.rmse_without_um, np.nan)
        rmse_um = tuple(held_out.rmse_with_um.tolist())
        reduction = tuple((1.0 - held_out.rmse_with_um / without).tolist())
    only = Candidate(
        family=model,
        rmse_um=rmse_um,
        reduction_rmse=reduction,
        relative_rmse=trust.held_out_relative_rmse,
        refused=trust.refused,
    )
    return Choice(family=model, why="it was asked for by name; nothing else was tried", candidates=(only,))


def choice_figures(choices: Mapping[str, Choice], channels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return ``{channel: {chosen: {family, why}, candidates: {family: {rmse_um, reduction_rmse}}}}``."""
    chosen = _chosen(choices)
    everything = [candidate for choice in choices.values() for candidate in choice.candidates]
    families = list(dict.fromkeys(one.family for one in everything))
    tried = {name: [one for one in everything if one.family == name] for name in families}
    return {
        channel: {"chosen": chosen, "candidates": {name: _figures(tried[name], index) for name in families}}
        for index, channel in enumerate(channels)
    }


def _chosen(choices: Mapping[str, Choice]) -> dict[str, Any]:
    counted = Counter(choice.family for choice in choices.values())
    family, often = counted.most_common(1)[0]
    whys = {name: choice.why for name, choice in choices.items() if choice.family == family}
    if len(choices) == 1:
        return {"family": family, "why": next(iter(whys.values()))}
    others = "".join(f", {other!r} in {count}" for other, count in counted.most_common()[1:])
    first = next(iter(whys))
    return {"family": family, "why": f"in {often} of {len(choices)} trainings{others}; {first}: {whys[first]}"}


def _figures(tried: Sequence[Candidate], channel: int) -> dict[str, Any]:
    known = [one for one in tried if one.rmse_um]
    refused = next((one.refused for one in tried if one.refused is not None), None)
    found: dict[str, Any] = {"rmse_um": None, "reduction_rmse": None}
    if known:
        found["rmse_um"] = finite_or_none(float(np.mean([one.rmse_um[channel] for one in known])))
        found["reduction_rmse"] = finite_or_none(float(np.mean([one.reduction_rmse[channel] for one in known])))
    return found if refused is None else found | {"refused": refused}
