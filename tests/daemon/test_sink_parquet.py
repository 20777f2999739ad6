"""The history as Parquet files by machine and day: whole files, each row once, read by DuckDB as the page says."""

import contextlib
import errno
import os
import random
import re
import resource
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.sinks.contract import SinkError
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.running import SinkRunner

pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
parquet = pytest.importorskip("pyarrow.parquet")
fs = pytest.importorskip("pyarrow.fs")

from daemon.sinks.parquet import ParquetSink, _ObjectStore  # noqa: E402 - needs pyarrow

PAGE = Path(__file__).parents[2] / "docs/how-to/send-history-to-a-plant.md"
DAY_S = 86_400.0
MIDNIGHT_S = EPOCH_S - EPOCH_S % DAY_S
MACHINE = "mill/7 north"
SENSORS = 3
"""On the line that is filled."""


def fill(store: Path, start_s: float, hours: float) -> None:
    """Rows of every stream, every ten minutes."""
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    for k in range(int(hours * 6)):
        first_s = start_s + 600.0 * k
        writer._clock.utc_s = first_s
        writer.temperatures(None, make.cycle("spindle", k + 1, first_s, 20.0 + np.array([k % 7, np.nan, 3.0]) / 16.0))
        writer.cnc_sample(make.cnc_sample(first_s + 1))
        writer.estimate(make.estimate(first_s + 2, np.array([1.0, np.nan, k])))
        written = make.macros(k + 1, np.array([0.0, k, 1.0]))
        write_id = writer.write_intent(make.command(np.array([0.0, k, 1.0])), written, "cycle")
        writer.write_outcome(write_id, make.receipt(first_s + 2, written))
        writer.displacement(make.displacement(first_s, np.array([1.0, 2.0, k])))
        writer.event("note", f"number {k}", "Ada")
    writer.reference(make.reference(start_s, len(SMALL.sensor_ids)))
    writer.close()


def config(folder: Path) -> SinkConfig:
    folder.mkdir(exist_ok=True)
    return SinkConfig.model_validate({"name": "files", "driver": "parquet", "parquet": {"folder": str(folder)}})


def send(store: Path, folder: Path, now_s: float, kind: type[ParquetSink] = ParquetSink) -> Cursor:
    """Write all that is over at a time."""
    stop = threading.Event()

    def sink(section: SinkConfig, machine: str) -> ParquetSink:
        return kind(section, machine, now_utc_s=lambda: now_s)

    runner = SinkRunner(config(folder), store, MACHINE, stop, sink, wait=lambda _duration_s: stop.set())
    runner.run()
    return runner.cursor


def files(folder: Path) -> dict[str, int]:
    """File -> records: a cycle of temperatures has a row per sensor."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): parquet.read_metadata(path).num_rows
        // (SENSORS if path.parts[-3] == "temperatures" else 1)
        for path in found
    }


def test_a_day_becomes_a_file_of_each_kind_when_it_is_over(tmp_path: Path) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 30.0)
    assert send(store, folder, MIDNIGHT_S + DAY_S + 7100.0).sent_rows == 0 and files(folder) == {}
    with Outbox(store) as outbox:
        position = Cursor.read(cursor_path(store, "files")).positions["cnc"]
        assert outbox.waiting(STREAMS["cnc"], position) == (180, MIDNIGHT_S + 1.0), "they were seen, and still wait"
    cursor = send(store, folder, MIDNIGHT_S + DAY_S + 7300.0)
    assert cursor.problem == ""
    kinds = ("cnc", "displacements", "estimates", "events", "temperatures", "writes")
    place = "machine=mill%2F7 north/2025-10-09.parquet"
    expected = {f"{kind}/{place}": 144 for kind in kinds} | {f"references/{place}": 1}
    assert files(folder) == dict(sorted(expected.items()))
    values = parquet.read_table(folder / "temperatures" / place).to_pylist()
    with HistoryReader(store) as reader:
        history = reader.temperatures(None, MIDNIGHT_S, MIDNIGHT_S + DAY_S)
    for sensor_id in history.sensor_ids:
        own = [row for row in values if row["sensor_id"] == sensor_id]
        times_s, degc, _ = history.series(sensor_id)
        assert [row["time_utc"].timestamp() for row in own] == times_s.tolist()
        got = np.array([row["degc"] for row in own], dtype=float)
        assert np.array_equal(got, degc, equal_nan=True), "no bit is lost"
    assert {(row["line"], row["quality"], row["reason"]) for row in values} == {("spindle", "good", "none")}
    assert [row["cycle"] for row in values if row["sensor_id"] == 12] == list(range(1, 145))
    assert send(store, folder, MIDNIGHT_S + DAY_S + 7300.0).sent_rows == cursor.sent_rows, "nothing is written twice"


def test_rows_that_come_late_make_their_day_anew(tmp_path: Path) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 30.0)
    send(store, folder, MIDNIGHT_S + 1.5 * DAY_S)
    housekeeping(store, HistoryConfig(), MIDNIGHT_S + 1.5 * DAY_S)
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    writer.displacement(make.displacement(MIDNIGHT_S + 90.0, np.zeros(3)))
    writer.close()
    send(store, folder, MIDNIGHT_S + 1.5 * DAY_S)
    found = files(folder)
    assert found["displacements/machine=mill%2F7 north/2025-10-09.parquet"] == 145
    assert found["cnc/machine=mill%2F7 north/2025-10-09.parquet"] == 144
    send(store, folder, MIDNIGHT_S + 2.5 * DAY_S)
    assert files(folder)["cnc/machine=mill%2F7 north/2025-10-10.parquet"] == 36


def test_a_store_that_lost_rows_does_not_take_them_from_the_files(tmp_path: Path) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 24.0)
    send(store, folder, MIDNIGHT_S + 2 * DAY_S)
    before = files(folder)
    store.unlink()
    fill(store, MIDNIGHT_S + 3600.0, 2.0)
    send(store, folder, MIDNIGHT_S + 2 * DAY_S)
    references = "references/machine=mill%2F7 north/2025-10-09.parquet"
    assert files(folder) == before | {references: before[references] + 1}, "the new store's own reference is new"


def test_a_full_disk_leaves_no_half_file(tmp_path: Path) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 24.0)

    class Full(ParquetSink):
        def _write(self, outbox, stream, day):
            limits = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
            try:
                return super()._write(outbox, stream, day)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    said = send(store, folder, MIDNIGHT_S + 2 * DAY_S, Full).problem
    assert "cannot be written" in said and "2025-10-09.parquet" in said
    assert all(rows == 144 for rows in files(folder).values()), "every file that is there is whole"
    assert send(store, folder, MIDNIGHT_S + 2 * DAY_S).problem == "" and len(files(folder)) == 7


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "No space left on device.*: free space on its disk"),
        (errno.EROFS, "Read-only file system.*: .*ReadWritePaths="),
        (errno.EACCES, "Permission denied.*: .*SupplementaryGroups="),
    ],
)
def test_what_keeps_a_file_from_being_written_is_named_with_what_to_do(tmp_path: Path, number: int, said: str) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 24.0)

    class Refused(ParquetSink):
        def _write(self, outbox, stream, day):
            self._files.put = refuse
            return super()._write(outbox, stream, day)

    def refuse(name: str, content: bytes) -> None:
        raise OSError(number, os.strerror(number), name)

    assert re.search(said, send(store, folder, MIDNIGHT_S + 2 * DAY_S, Refused).problem)


@pytest.mark.parametrize("content", [b"", b"PAR1 is how it begins", "foreign"])
def test_what_is_no_file_of_this_sink_is_named_and_left_alone(tmp_path: Path, content: bytes | str) -> None:
    store, folder = tmp_path / "h.sqlite", tmp_path / "files"
    fill(store, MIDNIGHT_S, 24.0)
    place = folder / "cnc/machine=mill%2F7 north/2025-10-09.parquet"
    place.parent.mkdir(parents=True)
    if isinstance(content, bytes):
        place.write_bytes(content)
    else:
        parquet.write_table(pyarrow.table({content: [1]}), place)
    before = place.read_bytes()
    said = send(store, folder, MIDNIGHT_S + 2 * DAY_S).problem
    assert "sink files: " in said and "2025-10-09.parquet: what stands there is no such file" in said
    assert place.read_bytes() == before
    place.unlink()
    assert send(store, folder, MIDNIGHT_S + 2 * DAY_S).problem == "" and len(files(folder)) == 7


@pytest.mark.wires
def test_an_object_store_that_is_killed_under_load_has_every_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server dies while a file goes to it, and once the sender before it has noted that one is there."""
    pytest.importorskip("moto", reason="moto is not installed")
    from object_store import BUCKET, ObjectStore, wire

    monkeypatch.delenv("AWS_REQUEST_CHECKSUM_CALCULATION", raising=False)
    for name, value in {"ACCESS_KEY_ID": "toolpoint", "SECRET_ACCESS_KEY": "x", "EC2_METADATA_DISABLED": "1"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    path, stop = tmp_path / "h.sqlite", threading.Event()
    fill(path, MIDNIGHT_S, 24.0)
    server, problems, deaths, followed = ObjectStore(), [], [], []
    killed = threading.Event()

    class Dying(ParquetSink):
        def _write(self, outbox, stream, day):
            rows = super()._write(outbox, stream, day)
            if stream.name == "estimates" and not deaths:
                deaths.append(day)
                raise SinkError("the sender dies before it has noted the acknowledgement")
            return rows

    def sink(section: SinkConfig, machine: str) -> ParquetSink:
        return Dying(section, machine, now_utc_s=lambda: MIDNIGHT_S + 2 * DAY_S)

    def before(piece: bytes) -> None:
        followed.extend(line for line in piece.lower().split(b"\r\n") if line.startswith(b"x-amz-trailer"))
        if b"/writes/" in piece and piece.startswith(b"PUT ") and not killed.is_set():
            server.kill()
            killed.set()

    def wait(_duration_s: float) -> None:
        problems.append(runner.cursor.problem)
        if not problems[-1] or len(problems) > 20:
            stop.set()
        elif "dies" not in problems[-1]:
            server.start()

    server.start()
    try:
        with wire(server.port, before) as port:
            bucket = f"s3://{BUCKET}/history?region=us-east-1&scheme=http&endpoint_override=127.0.0.1:{port}"
            section = {"name": "bucket", "driver": "parquet", "parquet": {"folder": bucket}}
            runner = SinkRunner(SinkConfig.model_validate(section), path, MACHINE, stop, sink, wait=wait)
            runner.run()
        found = server.objects()
    finally:
        server.end()
    assert not followed, "older stores, and other makers', keep a checksum that follows as a part of the file"
    assert killed.is_set() and deaths and problems[-1] == ""
    assert any("writes/machine=mill%2F7 north/2025-10-09.parquet cannot be written" in each for each in problems)
    assert send(path, tmp_path / "files", MIDNIGHT_S + 2 * DAY_S).problem == ""
    folder = tmp_path / "files"
    expected = {f"history/{name}": (folder / name).read_bytes() for name in files(folder)}
    assert found == expected and len(found) == 7


@pytest.mark.parametrize(
    ("code", "name", "said"),
    [
        (403, "RequestTimeTooSkewed", "this computer's clock"),
        (400, "ExpiredToken", "temporary ones (AWS_SESSION_TOKEN) expire"),
        (403, "InvalidAccessKeyId", "check AWS_ACCESS_KEY_ID in the unit's environment"),
        (403, "SignatureDoesNotMatch", "check AWS_SECRET_ACCESS_KEY in the unit's environment"),
        (404, "NoSuchBucket", "check `folder`"),
        (503, "SlowDown", "it is tried again"),
    ],
)
def test_an_object_store_that_refuses_is_named_without_its_keys(
    tmp_path: Path, code: int, name: str, said: str
) -> None:
    when_written = ("InvalidAccessKeyId", "SignatureDoesNotMatch")  # before, a code without a body is all that comes

    class Refusing(BaseHTTPRequestHandler):
        def do_PUT(self) -> None:
            number = f"<RequestId>{random.randrange(10**9)}</RequestId>"
            told = f'<?xml version="1.0"?><Error><Code>{name}</Code><Message>no</Message>{number}</Error>'
            body = told.encode() * (self.command != "HEAD")
            self.rfile.read(int(self.headers.get("Content-Length") or 0))
            self.send_response(404 if self.command == "HEAD" and name in when_written else code)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_HEAD = do_POST = do_PUT

        def log_message(self, *_words: object) -> None:
            pass

    store, stop = tmp_path / "h.sqlite", threading.Event()
    fill(store, MIDNIGHT_S, 0.5)
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        there = f"region=eu-central-1&scheme=http&endpoint_override=127.0.0.1:{server.server_port}"
        known = {"folder": f"s3://KEY:Hidden@plant/history?{there}"}
        section = SinkConfig.model_validate({"name": "files", "driver": "parquet", "parquet": known})

        def sink(section: SinkConfig, machine: str) -> ParquetSink:
            return ParquetSink(section, machine, now_utc_s=lambda: MIDNIGHT_S + 2 * DAY_S)

        runner = SinkRunner(section, store, MACHINE, stop, sink, wait=lambda _duration_s: stop.set())
        runner.run()
        server.shutdown()
    problem = runner.cursor.problem
    assert "sink files: s3://...@plant/history" in problem and "temperatures/machine=mill%2F7 north" in problem
    assert "Request ID" not in problem, "another number every time would be a new problem for the log"
    assert said in problem and "Hidden" not in problem and "Hidden" not in section.place
    assert runner.cursor.sent_rows == 0


class Losing:
    """Files of which the first ones are cut in half as they are written."""

    def __init__(self, losses: list[bool]) -> None:
        self._real, self._losses = fs.LocalFileSystem(), losses

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    @contextlib.contextmanager
    def open_output_stream(self, path: str) -> Iterator[Any]:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with self._real.open_output_stream(path) as stream:
            yield stream
        if self._losses and self._losses.pop(0):
            os.truncate(path, Path(path).stat().st_size // 2)


def test_a_file_of_which_an_object_store_lost_a_part_is_written_again(tmp_path: Path) -> None:
    store, folder, stop, problems = tmp_path / "h.sqlite", tmp_path / "files", threading.Event(), []
    fill(store, MIDNIGHT_S, 0.5)
    losses = [True, False, True, True]

    class AtBucket(ParquetSink):
        def _reach(self, address: str) -> _ObjectStore:
            found = _ObjectStore(f"file://{address}")
            found._files = Losing(losses)
            return found

    def sink(section: SinkConfig, machine: str) -> ParquetSink:
        return AtBucket(section, machine, now_utc_s=lambda: MIDNIGHT_S + 2 * DAY_S)

    def wait(_duration_s: float) -> None:
        problems.append(runner.cursor.problem)
        if not problems[-1] or len(problems) > 4:
            stop.set()

    runner = SinkRunner(config(folder), store, MACHINE, stop, sink, wait=wait)
    runner.run()
    assert problems[-1] == "", "it was left for a person to move away"
    assert all("stand there afterwards" in each for each in problems[:-1]) and len(problems) == 2 and not losses
    assert len(files(folder)) == 7


def test_the_examples_of_the_page_run_on_the_files(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed")
    store, folder = tmp_path / "h.sqlite", tmp_path / "history"
    fill(store, MIDNIGHT_S, 48.0)
    send(store, folder, MIDNIGHT_S + 3 * DAY_S)
    section = PAGE.read_text("utf-8").split("## Read the files with DuckDB", 1)[1].split("\n## ", 1)[0]
    (block,) = re.findall(r"```sql\n(.*?)```", section, re.S)
    shapes = {
        "/srv/plant/history": str(folder),
        "sensor_id = 61": "sensor_id = 13",
        "61, 62": "13, 12",
        "my machining centre": MACHINE,
        "2026-01-31": "2025-10-09",
    }
    for shown, here in shapes.items():
        block = block.replace(shown, here)
    queries = [query for query in block.split(";\n") if query.strip()]
    assert len(queries) == 4
    by_sensor = np.ma.filled(duckdb.sql(queries[2]).fetchnumpy()["13"], np.nan)
    with HistoryReader(store) as reader:
        history = reader.temperatures([13], MIDNIGHT_S, MIDNIGHT_S + DAY_S)
    assert np.array_equal(by_sensor, history.degc[:, 0], equal_nan=True), "exactly what the store has"
    for query in queries:
        rows = duckdb.sql(query).fetchall()
        assert rows and all(value is not None for value in rows[0]), query
