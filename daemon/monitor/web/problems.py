"""Refusals of the API: problem details (RFC 9457) with one sentence that says what to do."""

import json
from http import HTTPStatus
from typing import Any

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.responses import Response

PROBLEM_TYPE = "application/problem+json"


class Problem(BaseModel):
    """Why a request was not answered."""

    type: str = Field("about:blank", description="always about:blank: the status says what kind it is")
    title: str = Field(description="the status in words")
    status: int = Field(description="the HTTP status")
    detail: str = Field(description="a sentence for a person: what is wrong and what to do")


class ProblemError(Exception):
    """A request that is refused; becomes problem details."""

    def __init__(self, status: int, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, headers or {}


def problem_response(status: int, detail: str, headers: dict[str, str] | None = None) -> Response:
    content = Problem(type="about:blank", title=HTTPStatus(status).phrase, status=status, detail=detail)
    return Response(json.dumps(content.model_dump()), status, headers=headers, media_type=PROBLEM_TYPE)


def invalid_in_words(error: RequestValidationError) -> str:
    """Return what is wrong with a request, field by field."""
    return "; ".join(_field_in_words(each) for each in error.errors()[:5])


def _field_in_words(error: dict[str, Any]) -> str:
    place, *path = error["loc"]
    where = {"query": "query parameter", "path": "path", "body": "body"}.get(str(place), str(place))
    name = ".".join(str(part) for part in path)
    return f"{where} {name}: {error['msg'][:1].lower()}{error['msg'][1:]}".replace("  ", " ")
