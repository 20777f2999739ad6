"""The reference page of the API, made from its OpenAPI document by `make docs`."""

from collections.abc import Iterator, Mapping
from typing import Any

from fastapi import FastAPI

from daemon.monitor.web.application import openapi_document, routed

HEAD = """\
# API of the monitor

<!-- Made from the code by `make docs`; edit daemon/monitor/web/, not here. -->

`http://127.0.0.1:9464/api/v1` (`service.http_host`, `service.http_port`); `/openapi.json` describes the same for
programs. Times are UTC seconds since 1970, units stand in the names. Errors are problem details (RFC 9457,
`application/problem+json`): `status`, `title`, and `detail`, a sentence that says what is wrong and what to do.

Without accounts (`service.users`) anybody who reaches the monitor may look, and nobody may act. With accounts a session
(`POST /api/v1/session`, a cookie) is needed for everything; reading alone takes HTTP Basic too. An action carries the
session's token in the header `x-csrf-token`. [Open the monitor](../how-to/open-the-monitor.md) makes accounts.

Beside the API: `/` the pages, `/metrics` [for Prometheus](metrics.md), `/healthz` which answers `running` while the
process runs.
"""


def api_reference() -> str:
    """Return the page in Markdown."""
    document = openapi_document(routed(FastAPI()))
    schemas = document["components"]["schemas"]
    lines = HEAD.splitlines()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            lines += ["", f"## `{method.upper()} {path}`", "", operation["description"].strip()]
            lines += list(_taken(operation, schemas))
            lines += list(_answered(operation))
    lines += ["", "## Documents"]
    for name, schema in sorted(schemas.items()):
        lines += ["", f"### {name}", "", schema.get("description", "")]
        if "enum" in schema:
            lines += ["", f"One of {_type(schema)}."]
        if "properties" in schema:
            lines += ["", "| key | type | meaning |", "|---|---|---|"]
            lines += [
                f"| `{key}` | {_type(value)} | {_cell(value.get('description', ''))} |"
                for key, value in schema["properties"].items()
            ]
    return "\n".join(lines) + "\n"


def _taken(operation: Mapping[str, Any], schemas: Mapping[str, Any]) -> Iterator[str]:
    parameters = operation.get("parameters", [])
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema")
    if parameters:
        yield from ("", "| parameter | type | default | meaning |", "|---|---|---|---|")
    for one in parameters:
        schema = one["schema"]
        default = "required" if one["required"] else schema.get("default", "")
        yield f"| `{one['name']}` | {_type(schema)} | {default} | {_cell(one.get('description', ''))} |"
    if body is not None:
        yield from ("", f"Takes {_type(body)} as JSON.")


def _answered(operation: Mapping[str, Any]) -> Iterator[str]:
    yield from ("", "| status | answer |", "|---|---|")
    for status, answer in sorted(operation["responses"].items()):
        content = answer.get("content", {})
        kinds = [f"{_type(each['schema'])}" if each.get("schema") else kind for kind, each in content.items()]
        yield f"| {status} | {_cell(answer['description'])}{': ' if kinds else ''}{' or '.join(kinds)} |"


def _type(schema: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in schema:
        return " or ".join(_type(each) for each in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{each}`" for each in schema["enum"])
    kind = schema.get("type", "anything")
    if kind == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if kind == "object":
        inner = schema.get("additionalProperties")
        return f"object of {_type(inner)}" if isinstance(inner, Mapping) else "object"
    bounds = [f"at least {schema['minimum']:g}"] if "minimum" in schema else []
    bounds += [f"at most {schema['maximum']:g}"] if "maximum" in schema else []
    return f"{kind}{', ' if bounds else ''}{', '.join(bounds)}"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


if __name__ == "__main__":
    print(api_reference(), end="")
