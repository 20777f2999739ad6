"""Describes the models on the disk for the monitor, in a process of its own, which it alone starts.

`python -m daemon.model_release.describing`: standard input holds the configuration as JSON, standard output gets the
releases, the candidates with their scores and what stands against each, and the scores of the model in force, as JSON.
"""

import json
import os
import sys
from collections.abc import Mapping
from typing import Any

from config.files import read_whole, sha256_of
from config.records.release_record import ReleaseRecord
from config.schema import Configuration
from daemon.model_release.gate import channels_in_use
from daemon.model_release.loading import model_from_text
from daemon.model_release.releasing import Proposal, proposals, why_proposals_are_hidden
from daemon.model_release.repository import ReleaseRepository
from models.json_values import plain
from models.thermal.family import ThermalModel

NICENESS = 15


def described(configuration: Configuration) -> dict[str, Any]:
    """Return releases, the newest first, candidates, the newest first, and the scores of the model in force."""
    path = configuration.compensation.model_file
    records = [] if path is None else ReleaseRepository(path).records()
    numbers = {record.sha256: record.number for record in records}
    document = {
        "in_force": _in_force(configuration),
        "releases": [_release(record) for record in reversed(records)],
        "candidates": [_candidate(each, numbers, configuration) for each in reversed(proposals(configuration))],
        "hidden": why_proposals_are_hidden(configuration),
    }
    return plain(document)


def _in_force(configuration: Configuration) -> dict[str, Any]:
    path = configuration.compensation.model_file
    try:
        content = b"" if path is None else read_whole(path)
    except OSError:
        content = b""  # the daemon's own words about its model say why
    sensors = configuration.temperatures.sensor_ids
    model, _ = model_from_text(
        content, str(path), sensors, channels_in_use(configuration), configuration.cnc.axis_positions
    )
    return {"sha256": sha256_of(content), "scores": None if model is None else _scores(model, configuration)}


def _release(record: ReleaseRecord) -> dict[str, Any]:
    return {
        "release": record.number,
        "model_id": record.model_id,
        "action": record.action,
        "released_by": record.person,
        "released": record.released,
        "note": record.note,
        "checks": record.checks,
        "sha256": record.sha256,
    }


def _candidate(proposal: Proposal, numbers: Mapping[str, int], configuration: Configuration) -> dict[str, Any]:
    return {
        "file": proposal.path.name,
        "model_id": proposal.model_id,
        "sha256": proposal.sha256,
        "released_as": numbers.get(proposal.sha256),
        "against": proposal.inhibit,
        "scores": None if proposal.model is None else _scores(proposal.model, configuration),
    }


def _scores(model: ThermalModel, configuration: Configuration) -> dict[str, Any]:
    """Return what a model's training says of it, beside what the configuration asks of a release."""
    widest_um = channels_in_use(configuration)
    return {
        "kind": model.kind,
        "created": model.created,
        "recordings": [each.name for each in model.training],
        "hours": sum(each.to_hours - each.from_hours for each in model.training),
        "error_left": model.hyper_parameters.get("held_out_relative_rmse"),
        "refused": model.refused or "",
        "bands": [
            {
                "channel": channel,
                "band_um": float(model.band_um[place]),
                "widest_um": widest_um.get(channel),
                **({"unit": "um/m"} if channel in model.pivots_mm else {}),
            }
            for place, channel in enumerate(model.channels)
        ],
    }


def main() -> None:
    """Answer one request."""
    os.nice(NICENESS)
    json.dump(described(Configuration.model_validate_json(sys.stdin.read())), sys.stdout, allow_nan=False)


if __name__ == "__main__":
    main()
