"""The API of what is recorded: series, estimate with its reference marks, writes, downloads."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.responses import JSONResponse, Response

from daemon.history.columns.kinds import ESTIMATES, WRITES
from daemon.history.decimation import SeriesReader, recorded_hours
from daemon.history.reader import HistoryReader
from daemon.history.series import WriteRecord
from daemon.monitor.web import schemas
from daemon.monitor.web.access import Viewer
from daemon.monitor.web.estimate import AROUND_S, displacements_around, estimate_document, positions_around
from daemon.monitor.web.pages import takes_gzip
from daemon.monitor.web.problems import Problem, ProblemError
from daemon.monitor.web.recorded import Recorded, encoded
from models.json_values import finite_or_none, plain
from models.records import WriteOutcome

router = APIRouter(tags=["recorded"])
LATEST_UTC_S = 4_102_444_800.0
"""The year 2100."""
DEFAULT_SPAN_S = 3600.0
MOST_NAMES = 32
MOST_POINTS = 4000
MOST_ROWS = 1000
DAY_S = 86400.0

From = Annotated[
    float | None, Query(alias="from", ge=0, le=LATEST_UTC_S, description="UTC [s]; none: an hour before `to`")
]
To = Annotated[float | None, Query(alias="to", ge=0, le=LATEST_UTC_S, description="UTC [s]; none: now")]
Names = Annotated[
    list[Annotated[str, Query(max_length=100)]],
    Query(alias="name", min_length=1, max_length=MOST_NAMES, description="see /api/v1/names; may be repeated"),
]
BySensor = Annotated[bool, Query(description="false: without what each sensor carries")]
Points = Annotated[int, Query(ge=2, le=MOST_POINTS, description="at most so many buckets")]


HOUR_S = 3600.0
SEARCHED = ("reason", "cause", "person", "state")


def writes_document(
    reader: HistoryReader, from_s: float, to_s: float, limit: int, text: str, outcome: str, go_on: Callable[[], None]
) -> dict[str, Any]:
    """Return the latest writes of an interval, newest first; where given, only those with `text` and of `outcome`."""
    found: list[WriteRecord] = []
    for hour_ms in sorted(recorded_hours(reader, WRITES.name, from_s, to_s), reverse=True):
        go_on()
        begin_s, stop_s = max(from_s, hour_ms / 1e3), min(to_s, hour_ms / 1e3 + HOUR_S)
        found = [*(each for each in reader.writes(begin_s, stop_s) if _holds(each, text, outcome)), *found]
        if len(found) > limit:
            break
    more, found = len(found) > limit, found[-limit:]
    documents, hour, held = list[dict[str, Any]](), -1.0, dict[int, float | None]()
    for record in found:
        if record.time_s // HOUR_S != hour:
            go_on()
            hour = record.time_s // HOUR_S
            span_s = (hour - 1.0) * HOUR_S, (hour + 1.0) * HOUR_S
            before, model_of = deque(reader.writes(*span_s)), _models(reader, *span_s)
            held = {} if text or outcome else held  # of hours that are not listed nothing is known
        while before and before[0].write_id != record.write_id:
            if (earlier := before.popleft()).outcome is WriteOutcome.VERIFIED:
                held |= {number: finite_or_none(value) for number, value in earlier.macros}
        old = [held.get(number) for number, _ in record.macros]
        documents.append(write_document(record) | {"old": old, "model_id": model_of(record)})
    return {"writes": documents[::-1], "more": more}


def _holds(record: WriteRecord, text: str, outcome: str) -> bool:
    if outcome not in ("", record.outcome.name.lower()):
        return False
    return not text or any(text.lower() in (getattr(record, name) or "").lower() for name in SEARCHED)


def _models(reader: HistoryReader, from_s: float, to_s: float) -> Callable[[WriteRecord], str | None]:
    """Return what tells the model of the latest estimate before a write of the output."""
    frame = reader.frame(ESTIMATES, from_s, to_s, ("model_id",))
    times, names = (frame.integers("utc_ms") / 1e3).tolist(), frame.texts("model_id")

    def model_of(record: WriteRecord) -> str | None:
        place = bisect_right(times, record.time_s)
        return names[place - 1] if place and record.state is not None else None

    return model_of


def write_document(write: WriteRecord) -> dict[str, Any]:
    return plain(
        {
            "id": write.write_id,
            "time": write.time_s,
            "cause": write.cause,
            "person": write.person,
            "state": write.state,
            "reason": write.reason,
            "requested_um": write.requested_um,
            "compensation_um": write.compensation_um,
            "applied_um": write.applied_um,
            "limits_hit": write.limits_hit,
            "macros": [[number, finite_or_none(value)] for number, value in write.macros],
            "read_back": write.read_back,
            "outcome": write.outcome.name.lower(),
            "detail": write.detail,
            "delay_s": write.delay_s,
            "echoed_after_s": write.echoed_after_s,
        }
    )


def recorded_of(request: Request) -> Recorded:
    """Return the queries of the application that serves a request."""
    found = request.app.state.recorded
    assert isinstance(found, Recorded)
    return found


def interval(request: Request, from_s: float | None, to_s: float | None) -> tuple[float, float]:
    """Return the asked time as numbers; raises ProblemError when it is empty."""
    end_s = request.app.state.parts.clock.now().utc_s if to_s is None else to_s
    start_s = end_s - DEFAULT_SPAN_S if from_s is None else from_s
    if not start_s < end_s:
        raise ProblemError(422, f"from ({start_s:g}) must be before to ({end_s:g}); both are UTC [s since 1970]")
    return start_s, end_s


def _json(body: bytes, *, packed: bool) -> Response:
    headers = {"content-encoding": "gzip"} if packed else {}
    return Response(body, headers=headers | {"vary": "accept-encoding"}, media_type="application/json")


@router.get("/names", response_model=schemas.Names)
async def names(request: Request, person: Viewer) -> Response:
    """Return the series that can be asked for."""
    configuration = request.app.state.parts.configuration
    series: list[dict[str, Any]] = [
        {
            "name": f"temperature.{sensor.id}",
            "kind": "temperature",
            "unit": "degC",
            "component": sensor.component,
            "part": None if sensor.part == "-" else sensor.part,
            "label": sensor.label,
            "sensor": sensor.id,
            "position": None,
        }
        for sensor in configuration.temperatures.every_sensor
    ]
    series += [
        {"name": f"{kind}.{label}", "kind": kind, "unit": "degC", "label": label}
        for label in configuration.temperatures.labels
        for kind in ("label", "label_reference")
    ]
    by_channel = {axis.estimate: name for name, axis in configuration.compensation.axes.items() if axis.estimate}
    channels, slopes = list(by_channel), configuration.compensation.slope_channels
    if configuration.displacements is not None:
        channels += [each.name for each in configuration.displacements.every_channel]
    for channel in dict.fromkeys(channels):
        own = {"unit": "um/m" if channel in slopes else "um", "channel": channel, "axis": by_channel.get(channel)}
        if channel in by_channel:
            series += [{"name": f"{kind}.{channel}", "kind": kind} | own for kind in ("estimated", "band")]
        series.append({"name": f"measured.{channel}", "kind": "measured"} | own)
    series += [
        {"name": f"{kind}.{axis}", "kind": kind, "unit": "um", "axis": axis} | configuration.compensation.unit_of(axis)
        for axis in configuration.compensation.axes
        for kind in ("requested", "written", "applied")
    ]
    series.append({"name": "spindle_speed", "kind": "spindle", "unit": "1/min"})
    series.append({"name": "motor_temperature", "kind": "motor", "unit": "degC"})

    def ask(reader: HistoryReader, go_on: object) -> tuple[float, float] | None:
        return reader.extent("temperatures")

    extent = await recorded_of(request).query(ask)
    first, last = extent or (None, None)
    return JSONResponse({"series": series, "first": first, "last": last})


@router.get(
    "/series",
    response_model=dict[str, schemas.Series],
    responses={404: {"model": Problem, "description": "there is no series of that name"}},
)
async def series(
    request: Request, person: Viewer, name: Names, from_s: From = None, to_s: To = None, points: Points = 800
) -> Response:
    """Return series over time, each decimated to least, greatest and mean of at most `points` buckets."""
    start_s, end_s = interval(request, from_s, to_s)
    packed = takes_gzip(request.headers)
    unique = list(dict.fromkeys(name))
    return _json(await recorded_of(request).series(unique, start_s, end_s, points, packed=packed), packed=packed)


@router.get("/writes", response_model=schemas.Writes)
async def writes(
    request: Request,
    person: Viewer,
    from_s: From = None,
    to_s: To = None,
    limit: Annotated[int, Query(ge=1, le=MOST_ROWS)] = 200,
    reason: Annotated[
        str | None, Query(max_length=200, description="only writes whose reason, cause or person holds this text")
    ] = None,
    outcome: Annotated[schemas.Outcome | None, Query(description="only writes that ended like this")] = None,
) -> Response:
    """Return the audit of macro writes, the newest first."""
    start_s, end_s = interval(request, from_s, to_s)

    def ask(reader: HistoryReader, go_on: Callable[[], None]) -> bytes:
        found = writes_document(reader, start_s, end_s, limit, reason or "", outcome or "", go_on)
        return encoded(found, packed=packed)

    packed = takes_gzip(request.headers)
    return _json(await recorded_of(request).query(ask), packed=packed)


@router.get("/past-events", response_model=schemas.Events)
async def past_events(
    request: Request,
    person: Viewer,
    from_s: From = None,
    to_s: To = None,
    limit: Annotated[int, Query(ge=1, le=MOST_ROWS)] = 200,
    kind: Annotated[str, Query(max_length=40, description="only events of this kind, such as state")] = "",
    text: Annotated[str, Query(max_length=200, description="only events whose text or person holds this")] = "",
) -> Response:
    """Return what happened: changes of state, references, requests with the person, faults; the newest first."""
    start_s, end_s = interval(request, from_s, to_s)

    def ask(reader: SeriesReader, go_on: object) -> bytes:
        found, kinds = reader.latest_events(start_s, end_s, kind, text, limit + 1)
        events = [{"time": e.time_s, "kind": e.kind, "text": e.text, "person": e.person} for e in found[:limit]]
        return encoded({"events": events, "kinds": kinds, "more": len(found) > limit}, packed=packed)

    packed = takes_gzip(request.headers)
    return _json(await recorded_of(request).query(ask), packed=packed)


@router.get(
    "/export",
    response_class=Response,
    responses={
        200: {"content": {"text/csv": {}, "application/vnd.apache.parquet": {}}, "description": "the file"},
        404: {"model": Problem, "description": "there is nothing of that kind in that time"},
    },
)
async def export(
    request: Request,
    person: Viewer,
    what: schemas.ExportWhat = schemas.ExportWhat.RECORDING,
    form: Annotated[schemas.ExportFormat, Query(alias="format")] = schemas.ExportFormat.CSV,
    from_s: From = None,
    to_s: To = None,
) -> Response:
    """Download records; a recording is what `toolpoint thermal train` reads: one-minute means of everything."""
    start_s, end_s = interval(request, from_s, to_s)
    configuration = request.app.state.parts.configuration.model_dump_json()
    asked = {"configuration": configuration, "what": what, "format": form, "from_s": start_s, "to_s": end_s}
    name = f"{what}-{datetime.fromtimestamp(end_s, UTC):%Y%m%dT%H%M%SZ}.{form}"
    media_type = "text/csv" if form is schemas.ExportFormat.CSV else "application/vnd.apache.parquet"
    answer: Response = await request.app.state.downloads.begin(asked, name, media_type)
    return answer


@router.get("/estimate", response_model=schemas.Estimate)
async def estimate(request: Request, person: Viewer, contributions: BySensor = True) -> Response:
    """Return the estimate now: per channel band, contributions of sensors, residual to what is measured."""
    parts = request.app.state.parts
    now_s, reference = parts.clock.now().utc_s, parts.board.control.reference

    def ask(reader: HistoryReader, go_on: object) -> tuple[list[dict[str, Any]], list[dict[str, float]]]:
        marks = [
            {"id": each.reference_id, "time": each.time.utc_s, "source": each.source}
            for each in reader.references(now_s - DAY_S, now_s + 1.0)
        ]
        if reference is None:
            return marks, [{}, {}]
        moments = (reference.time.utc_s, now_s - AROUND_S)
        um = [displacements_around(reader, time_s, AROUND_S) for time_s in moments]
        return marks, um + [positions_around(parts.configuration, reader, time_s, AROUND_S) for time_s in moments]

    marks, measured = await recorded_of(request).query(ask)
    document = estimate_document(parts.configuration, parts.board, *measured)
    if not contributions:
        document["channels"] = {name: of | {"contributions": None} for name, of in document["channels"].items()}
    return JSONResponse(document | {"references": marks})
