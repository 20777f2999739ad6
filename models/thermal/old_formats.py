"""Reads thermal models in the formats of versions up to 0.1.0."""

from typing import Any

from models.headless_file import parse, record_from, unsigned
from models.model_file import ModelError
from models.thermal.linear import LinearModel

SAME_1 = {"model_id", "kind", "channels", "sensor_ids", "sensor_names", "drift_um_per_min", "band_um", "training"}
SAME_1 |= {"created"}
OWN_1 = {"coefficients_um_per_k", "interval_min", "ridge_k2", "lowest_increment_k", "highest_increment_k"}
SAME_2 = {"model_id", "kind", "channels", "sensor_ids", "sensor_names", "layout", "speed_scale_rpm", "period_min"}
SAME_2 |= {"centre", "band_um", "watch", "hyper_parameters", "refused", "training", "created"}
OWN_2 = {"ridges", "leverage_limit", "lowest_degc", "highest_degc", "highest_speed_rpm"}
OPTIONAL = {"axis_positions"}


def old_model(text: str) -> LinearModel:
    """Return the model that a file of format 1 (telescoped) or 2 (with lags) holds, as versions up to 0.1.0 wrote them.

    Raises ModelError naming the key: not JSON, an unknown format version, missing or unknown keys, a checksum that
    differs, or what the model itself refuses.
    """
    content = parse(text)
    version = content.get("format_version")
    if isinstance(version, bool) or version not in (1, 2):
        raise ModelError("format_version", f"{version!r} is unknown; this version of Toolpoint reads 1, 2 and 3")
    wanted = (SAME_1 | OWN_1 if version == 1 else SAME_2 | OWN_2) | {"format_version", "sha256", "test_vectors"}
    if missing := sorted(wanted - set(content)):
        raise ModelError(missing[0], "is missing")
    if unknown := sorted(set(content) - wanted - OPTIONAL):
        raise ModelError(unknown[0], "is not a key of this format")
    bare = unsigned(content, "training")
    try:
        fields = _telescoped(bare) if version == 1 else _lagged(bare)
    except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
        raise ModelError("", f"does not hold what format {version} holds ({error!r:.80})") from error
    return record_from(fields | {key: bare[key] for key in OPTIONAL if key in bare}, LinearModel)


def _telescoped(old: dict[str, Any]) -> dict[str, Any]:
    sensors = len(old["sensor_ids"])
    layout = {"sensors": sensors, "lags_min": [], "speed_lags_min": []}
    solution = {
        "layout": layout,
        "design": {"departures": False},
        "gain": [1.0] * sensors,
        "weights": [list(column) for column in zip(*old["coefficients_um_per_k"], strict=True)],
    }
    own = {
        "layout": layout,
        "speed_scale_rpm": 1.0,
        "period_min": 1.0,
        "solutions": [solution],
        "centre": [0.0] * sensors,
        "domain": {
            "of_increments": True,
            "lowest": old["lowest_increment_k"],
            "highest": old["highest_increment_k"],
        },
        "watch": None,
        "hyper_parameters": {"interval_min": old["interval_min"], "ridge_k2": old["ridge_k2"]},
        "refused": None,
        "test_vectors": [
            {
                "features": vector["degc"],
                "reference": vector["reference_degc"],
                "elapsed_min": vector["elapsed_min"],
                "thermal_error_um": vector["thermal_error_um"],
            }
            for vector in old["test_vectors"]
        ],
    }
    return {key: old[key] for key in SAME_1} | own


def _lagged(old: dict[str, Any]) -> dict[str, Any]:
    own = {
        "solutions": [ridge | {"layout": old["layout"]} for ridge in old["ridges"]],
        "drift_um_per_min": [0.0] * len(old["channels"]),
        "domain": {
            "of_increments": False,
            "lowest": old["lowest_degc"],
            "highest": old["highest_degc"],
            "highest_speed_rpm": old["highest_speed_rpm"],
            "leverage_limit": old["leverage_limit"],
        },
        "test_vectors": [vector | {"elapsed_min": 0.0} for vector in old["test_vectors"]],
    }
    return {key: old[key] for key in SAME_2} | own
