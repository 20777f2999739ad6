"""`toolpoint history` and `toolpoint export`: what people and other programs get of the store."""

import csv
import io
import json
import re
import sys
import time
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from click.testing import CliRunner, Result
from history_records import EPOCH_S, SMALL, StillClock
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from daemon.cli import main
from daemon.cli.operate.history_view import print_rows, view
from daemon.history.export import complete_file, write_parquet
from daemon.history.reader import HistoryReader
from daemon.history.tables import Table
from daemon.history.writer import HistoryWriter
from daemon.monitor.web.api_history import LATEST_UTC_S, writes_document
from models.quality import Reason
from models.records import WriteOutcome

FROM, TO = "2025-10-09T09:00", "2025-10-09T13:00:00+00:00"
assert EPOCH_S == 1_760_000_400.0, "2025-10-09T09:00:00Z"


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def fill(path: Path, start_s: float) -> None:
    """Two hours with something of everything, the first of them packed."""
    clock = StillClock(start_s)
    writer = HistoryWriter(path, clock=clock, machine=SMALL)
    writer.start()
    for k in range(12):
        first_s = start_s + 600.0 * k
        clock.utc_s = first_s + 2
        spindle = make.cycle("spindle", k + 1, first_s, [23.0 + k / 16, 21.0, np.nan if k == 2 else 22.0])
        quality, reason = make.codes(3), make.codes(3)
        if k == 2:
            quality[2], reason[2] = 2, Reason.NOT_RECEIVED
        if k == 3:
            quality[1], reason[1] = 1, Reason.RATE
        writer.temperatures(make.cleansed(SMALL, spindle, quality, reason), spindle)
        writer.temperatures(None, make.cycle("bed", k + 1, first_s + 1, [19.0, 18.0625]))
        writer.cnc_sample(make.cnc_sample(first_s + 1, macros={600: 0.5} if k < 8 else {600: None, 601: 7.0}))
        writer.estimate(make.estimate(first_s, [1.0 + k, np.nan, -1 / 3]))
        writer.displacement(
            make.displacement(first_s, [1 / 3, np.nan, 3.0], reason=np.array([0, 9, 0], dtype=np.uint8))
        )
        written = make.macros(k + 1, np.array([0.0, 1 / 3, -2.0]))
        write_id = writer.write_intent(make.command([0.0, 1 / 3, -2.0]), written, "cycle", None)
        differs = {"outcome": WriteOutcome.DIFFERS, "read_back": (None, *[value for _, value in written][1:])}
        if k != 11:
            writer.write_outcome(write_id, make.receipt(first_s, written, **(differs if k == 4 else {})))
        writer.event("state", f"[bold] {k}", "somebody")
    writer.close()
    assert writer.dropped == {}
    housekeeping(path, HistoryConfig(pack_after_s=3600.0), start_s + 7200.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "history.sqlite"
    fill(path, EPOCH_S)
    return path


@pytest.fixture(scope="module")
def recent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recent") / "history.sqlite"
    fill(path, time.time() - 7000.0)
    return path


def exported(store: Path, what: str, *more: str) -> list[dict[str, str]]:
    result = run("export", "--store", store, "--what", what, "--from", FROM, "--to", TO, "-o", "-", *more)
    assert result.exit_code == 0, result.output
    return list(csv.DictReader(io.StringIO(result.stdout)))


class TestExport:
    def test_temperatures(self, store: Path) -> None:
        rows = exported(store, "temperatures", "--sensors", "11-12,21")
        assert list(rows[0]) == ["time_utc", "utc_s", "line", "cycle", "t11_degc", "t12_degc", "t21_degc"]
        assert len(rows) == 24
        assert list(rows[0].values()) == [
            "2025-10-09T09:00:00.000Z",
            "1760000400.0",
            "spindle",
            "1",
            "21.0",
            "22.0",
            "",
        ]
        assert list(rows[1].values())[2:] == ["bed", "1", "", "", "19.0"]
        assert rows[4]["t12_degc"] == "", "nothing was measured there"

    def test_cnc_with_macros_that_appear_later(self, store: Path) -> None:
        rows = exported(store, "cnc")
        assert [name for name in rows[0] if name.startswith("macro_")] == ["macro_600", "macro_601"]
        assert [rows[0]["macro_601"], rows[11]["macro_601"], rows[11]["macro_600"]] == ["", "7.0", ""]
        assert (rows[0]["spindle_speed_rpm"], rows[0]["alarm"], rows[0]["mode"]) == ("6000.0", "0", "memory")
        assert rows[0]["clock_s"] == "78.0"

    def test_writes(self, store: Path) -> None:
        rows = exported(store, "writes")
        assert [row["outcome"] for row in rows] == ["verified"] * 4 + ["differs"] + ["verified"] * 6 + ["intended"]
        assert rows[0]["macro_502"] == rows[0]["macro_502_read_back"] == str(1 / 3 / 1000)
        assert (rows[4]["macro_500"], rows[4]["macro_500_read_back"]) == ("5.0", "")
        assert rows[11]["macro_502_read_back"] == "", "nobody knows yet"
        assert (rows[0]["Y_requested_um"], rows[0]["Y_compensation_um"], rows[0]["Y_applied_um"]) == (
            "0.417",
            "0.333",
            "1.5",
        )
        assert float(rows[0]["read_back_delay_s"]) == pytest.approx(0.0016)

    def test_part_of_the_time(self, store: Path) -> None:
        result = run(
            *("export", "--store", store, "--what", "cnc", "--from", "2025-10-09T10:00+01:00"),
            *("--to", "2025-10-09T09:30:00Z", "-o", "-"),
        )
        assert len(result.stdout.splitlines()) == 1 + 3

    def test_file_is_complete_or_absent(self, store: Path, tmp_path: Path) -> None:
        output = tmp_path / "t.csv"
        result = run("export", "--store", store, "--what", "cnc", "--from", FROM, "--to", TO, "-o", output)
        assert result.exit_code == 0
        assert "12 rows of cnc written" in result.stderr
        assert result.stdout == ""
        assert len(output.read_text().splitlines()) == 13
        absent = run(
            "export", "--store", store, "--what", "cnc", "--from", FROM, "--to", TO, "-o", tmp_path / "no" / "t.csv"
        )
        assert absent.exit_code == 2
        assert "cannot be written (No such file or directory)" in absent.stderr
        assert sorted(path.name for path in tmp_path.iterdir()) == ["t.csv"]

    def test_without_an_end_all_that_there_is(self, tmp_path: Path) -> None:
        """A replay of eight hours records in the future; up to now there was next to nothing of it."""
        fill(store := tmp_path / "history.sqlite", time.time() + 7000.0)
        result = run("export", "--store", store, "--what", "cnc", "--from", "-1h", "-o", tmp_path / "c.csv")
        assert result.exit_code == 0, result.output
        assert len((tmp_path / "c.csv").read_text().splitlines()) == 13

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--what", "cnc", "--from", "yesterday"], "'yesterday' is no time; write 2026-03-01T08:00"),
            (["--what", "cnc", "--from", TO, "--to", FROM], "--to (2025-10-09T09:00:00Z) must be later than --from"),
            (["--what", "cnc", "--from", "-1h"], "no cnc from"),
            (["--what", "cnc", "--from", FROM, "--sensors", "1"], "go with --what temperatures, not with cnc"),
            (["--what", "temperatures", "--from", FROM, "--sensors", "11,99"], "the store knows no sensors [99]"),
            (["--what", "temperatures", "--from", FROM, "--sensors", "1-"], "'1-' is no list of sensors"),
            (["--what", "temperatures", "--from", FROM, "--sensors", "5-1"], "range 5-1 runs backwards"),
            (["--what", "weather", "--from", FROM], "'weather' is not one of"),
            (["--what", "cnc", "--from", FROM, "--format", "parquet"], "cannot go to standard output"),
        ],
    )
    def test_bad_usage(self, store: Path, arguments: list[str], words: str) -> None:
        result = run("export", "--store", store, "-o", "-", *arguments)
        assert result.exit_code == 2
        assert words in result.stderr
        assert result.stdout == ""

    def test_events_say_when_what_and_who(self, store: Path) -> None:
        rows = exported(store, "events")
        assert len(rows) == 12
        assert list(rows[0]) == ["time_utc", "utc_s", "kind", "text", "person"]
        assert (rows[3]["kind"], rows[3]["text"], rows[3]["person"]) == ("state", "[bold] 3", "somebody")
        assert rows[3]["time_utc"] > rows[2]["time_utc"] > "2025-10-09T09"

    def test_absent_store(self, tmp_path: Path) -> None:
        store = tmp_path / "absent.sqlite"
        result = run("export", "--store", store, "--what", "cnc", "--from", FROM, "-o", "-")
        assert (result.exit_code, "there is no history store" in result.stderr) == (2, True)


class TestParquet:
    def test_absent_extra_is_named(self, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        output = tmp_path / "c.parquet"
        arguments = ("--what", "cnc", "--from", FROM, "--to", TO, "--format", "parquet", "-o", output)
        result = run("export", "--store", store, *arguments)
        assert result.exit_code == 2
        assert "install toolpoint[parquet], or choose --format csv" in result.stderr
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("what", ["temperatures", "displacements", "cnc", "estimates", "writes", "events"])
    def test_same_content_as_csv(self, store: Path, tmp_path: Path, what: str) -> None:
        parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
        path = tmp_path / "t.parquet"
        with HistoryReader(store) as reader:
            rows = write_parquet(Table(reader, what, EPOCH_S, EPOCH_S + 1e5, quality=True), path)
        found = parquet.read_table(path)
        csv_rows = exported(store, what, *(["--quality"] if what == "temperatures" else []))
        assert found.num_rows == rows == len(csv_rows)
        assert found.column_names == list(csv_rows[0])
        assert str(found.schema.field("time_utc").type) == "timestamp[ms, tz=UTC]"
        for name in found.column_names:
            for value, text in zip(found.column(name).to_pylist(), (row[name] for row in csv_rows), strict=True):
                assert (value in (None, "")) == (text == ""), name
                if isinstance(value, float):
                    assert value == float(text), name

    def test_the_suffix_of_the_file_chooses_the_format(self, store: Path, tmp_path: Path) -> None:
        path = tmp_path / "t.parquet"
        arguments = ["export", "--store", store, "--what", "cnc", "--from", "2025-01-01", "-o", path]
        assert run(*arguments).exit_code == 0
        parquet = pytest.importorskip("pyarrow.parquet")
        assert parquet.read_table(path).num_rows == 12
        refused = run(*arguments, "--format", "csv")
        assert refused.exit_code == 2
        assert "--format csv does not go with a file named t.parquet; leave one of them out" in refused.stderr


class TestHistory:
    def test_summary(self, store: Path) -> None:
        result = run("history", "--store", store, "--json", "-")
        assert result.exit_code == 0, result.output
        content = json.loads(result.stdout)
        assert content["kinds"]["temperatures"] == {
            "rows": 24,
            "first_utc": "2025-10-09T09:00:00Z",
            "last_utc": "2025-10-09T10:50:01Z",
        }
        assert {kind: found["rows"] for kind, found in content["kinds"].items()} == {
            "temperatures": 24,
            "cnc": 12,
            "displacements": 12,
            "estimates": 12,
            "writes": 12,
            "events": 12,
            "probes": 0,
        }
        assert content["acknowledged_cycle"] == {"spindle": 12, "bed": 12}
        assert content["writes_without_outcome"] == [12]
        assert content["sensors"] == 5

    @pytest.mark.parametrize("what", ["writes", "estimates", "cnc", "events"])
    def test_rows_as_json(self, recent: Path, what: str) -> None:
        rows = json.loads(run("history", "--store", recent, what, "--last", "3h", "--json", "-").stdout)
        assert len(rows) == 12
        expected = {
            "writes": ("outcome", "verified"),
            "estimates": ("dy_thermal_error_um", None),
            "cnc": ("spindle_speed_rpm", 6000.0),
            "events": ("text", "[bold] 0"),
        }
        name, value = expected[what]
        assert rows[0][name] == value
        assert rows[0]["time_utc"] < rows[-1]["time_utc"]

    @pytest.mark.parametrize("what", ["writes", "estimates", "cnc", "events"])
    def test_in_a_pipe_nothing_is_cut_and_a_record_is_one_line(self, recent: Path, what: str) -> None:
        arguments = ["history", "--store", str(recent), what, "--last", "3h"]
        lines = CliRunner(env={"COLUMNS": "80"}).invoke(main, arguments).stdout.splitlines()
        times = [line for line in lines if re.search(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\dZ", line)]
        assert len(times) == 12
        assert "…" not in "".join(lines)
        if what == "cnc":
            assert all("#600=" in line and "#601=" in line for line in times)

    def test_in_a_pipe_one_long_event_makes_no_other_line_longer(self, tmp_path: Path) -> None:
        long, short = "word " * 90, "OFF -> ARMED: switched on"
        with_events = HistoryWriter(tmp_path / "history.sqlite", clock=StillClock(time.time()), machine=SMALL)
        with_events.start()
        for text in (short, long.strip(), short):
            with_events.event("state", text, None)
        with_events.close()
        lines = run("history", "--store", tmp_path / "history.sqlite", "events").stdout.splitlines()
        of_records = [line for line in lines if "state" in line]
        assert [long.strip() in line for line in of_records] == [False, True, False]
        assert max(len(line) for line in of_records if short in line) <= 80

    @pytest.mark.parametrize("what", ["writes", "estimates", "cnc", "events"])
    def test_at_80_columns_every_word_is_whole(
        self, recent: Path, what: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("TERM", "dumb")
        with HistoryReader(recent) as reader:
            headings, rows = view(reader, what, 0.0)
        monkeypatch.setenv("COLUMNS", "400")
        print_rows("wide", headings, rows)
        wide = set(re.sub(r"\x1b\[[0-9;]*m|[^\w#=+.:-]", " ", capsys.readouterr().out).split())
        monkeypatch.setenv("COLUMNS", "80")
        print_rows("wide", headings, rows)
        lines = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
        assert max(map(len, lines)) <= 80
        missing = wide - set(re.sub(r"[^\w#=+.:-]", " ", "\n".join(lines)).split())
        assert missing <= {"-", *" ".join(headings).split()}, "a heading is left out with a value that is not there"

    def test_probes_of_a_store_that_has_none(self, store: Path) -> None:
        result = run("history", "--store", store, "probes")
        assert (result.exit_code, result.stdout) == (0, "No probes in this time; the store has none at all.\n")

    def test_store_of_the_configuration(self, store: Path, tmp_path: Path) -> None:
        shipped = Path(__file__).resolve().parents[2] / "config" / "cfrpmt.yaml"
        configured = tmp_path / "machine.yaml"
        text = shipped.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if "/history.sqlite" not in line]
        at = next((i for i, line in enumerate(lines) if line.startswith("history:")), None)
        lines[at : at + 1 if at is not None else None] = [f"history: {{path: {store}}}"] if at is not None else []
        if at is None:
            lines.append(f"history: {{path: {store}}}")
        configured.write_text("\n".join(lines) + "\n", encoding="utf-8")
        result = run("history", "--config", configured, "--json", "-")
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)["store"] == str(store)

    def test_store_that_is_being_written(self, tmp_path: Path) -> None:
        path = tmp_path / "history.sqlite"
        writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
        writer.start()
        writer.event("note", "one")
        writer.submit(lambda _: None).result(30)
        content = json.loads(run("history", "--store", path, "--json", "-").stdout)
        writer.close()
        assert content["kinds"]["events"]["rows"] == 1


def test_a_link_in_the_place_of_the_unfinished_file_is_not_followed(tmp_path: Path) -> None:
    """Root exports into a folder of somebody else, who knows the name."""
    (tmp_path / "of_root").write_text("left as it is")
    (tmp_path / "day.csv.partial").symlink_to(tmp_path / "of_root")
    with complete_file(tmp_path / "day.csv") as partial:
        partial.write_text("new")
    assert (tmp_path / "of_root").read_text() == "left as it is"
    assert (tmp_path / "day.csv").read_text() == "new" and not (tmp_path / "day.csv").is_symlink()


def test_a_row_of_1969_and_one_of_2099_leave_no_million_of_empty_hours_to_walk(tmp_path):
    times_s = [-10.0, 10.0, EPOCH_S, EPOCH_S + 7000.0, 4_070_908_800.0]
    writer = HistoryWriter(tmp_path / "h.sqlite", clock=StillClock(EPOCH_S), machine=SMALL)
    writer.start()
    for time_s in times_s:
        writer.displacement(make.displacement(time_s, [1.0, 2.0, 3.0]))
        writer.estimate(make.estimate(max(time_s, 0.0) - 1.0, np.zeros(3), model_id="m1"))
        written = make.macros(1, np.array([0.0, 1.0, -2.0]))
        writer._clock.utc_s = max(time_s, 0.0)
        writer.write_intent(make.command([0.0, 1.0, -2.0]), written, "cycle", None)
    writer.close()
    with HistoryReader(tmp_path / "h.sqlite") as reader:
        table = Table(reader, "displacements", -1e6, 5e9)
        assert table.window_count == len(times_s)
        assert [time for window in table.windows() for time in window[1]] == times_s
        assert Table(reader, "displacements", EPOCH_S + 1.0, EPOCH_S + 6999.0).window_count <= 2
        assert Table(reader, "displacements", 4.08e9, 5e9).window_count == 0
        looks: list[None] = []
        spans_s: list[float] = []
        frame = reader.frame
        reader.frame = lambda kind, from_s, to_s, *names: (
            spans_s.append(to_s - from_s) or frame(kind, from_s, to_s, *names)
        )
        found = writes_document(reader, 0.0, LATEST_UTC_S, 50, "", "", lambda: looks.append(None))
    assert len(found["writes"]) == len(times_s) and len(looks) <= 2 * len(times_s)
    assert max(spans_s) <= 7200.0, "two writes of 130 years read no estimates of the years between"
    assert {each["model_id"] for each in found["writes"]} <= {"m1", None}


def test_what_stood_there_before_is_not_that_of_the_write_before_it_which_is_listed(tmp_path):
    writer = HistoryWriter(tmp_path / "h.sqlite", clock=StillClock(EPOCH_S), machine=SMALL)
    writer.start()
    for number, cause in enumerate(("cycle", "retreat", "cycle")):
        writer._clock.utc_s = EPOCH_S + 10.0 * number
        written = make.macros(number, np.array([0.0, float(number), -2.0]))
        intent = writer.write_intent(make.command([0.0, float(number), -2.0]), written, cause, None)
        writer.write_outcome(intent, make.receipt(EPOCH_S, written))
    writer.close()
    with HistoryReader(tmp_path / "h.sqlite") as reader:
        whole = writes_document(reader, 0.0, LATEST_UTC_S, 50, "", "", lambda: None)["writes"]
        listed = writes_document(reader, 0.0, LATEST_UTC_S, 50, "cycle", "", lambda: None)["writes"]
    assert [each["cause"] for each in listed] == ["cycle", "cycle"] and listed == [whole[0], whole[2]]
    assert whole[0]["old"] == [value for _, value in whole[1]["macros"]]
