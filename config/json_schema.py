"""The configuration as JSON Schema, for editors and other programs."""

from typing import Any

from config.schema import Configuration


def configuration_json_schema() -> dict[str, Any]:
    """Return the configuration's JSON Schema (draft 2020-12)."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Configuration.model_json_schema(),
        "title": "Toolpoint configuration",
    }
