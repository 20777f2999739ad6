"""The simulated logger's CSV: its layout, its growth and what can happen to it."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scripted_machine import displacements

from config.schema.displacements import DisplacementChannelConfig, DisplacementFileConfig, DisplacementsConfig
from drivers.sim.faults import Fault, FaultKind
from drivers.sim.wires.displacement_wire import DisplacementCsv

START_UTC_S = datetime(2024, 3, 1, 8, 0, 0, tzinfo=UTC).timestamp()
HEAD = b"\xef\xbb\xbfTime,X1,Z\r\n"
ROWS = [b"2024-03-01T08:00:00,0.500,0.002\r\n", b"2024-03-01T08:01:00,0.500,0.002\r\n"]


def csv(config: DisplacementsConfig, *faults: Fault) -> DisplacementCsv:
    return DisplacementCsv(
        config, lambda: {"x1": 0.5, "z": -1.5, "y": 9.0}, lambda time_s: START_UTC_S + time_s, faults=faults
    )


def fault(kind: FaultKind, at_s: float, **more: Any) -> Fault:
    return Fault(kind=kind, at_s=at_s, **more)


def test_one_row_a_minute_after_a_header(tmp_path: Path) -> None:
    logger = csv(displacements(tmp_path))
    for tenth in range(0, 1199):
        logger.step(tenth / 10)
    assert logger.path.read_bytes() == HEAD + b"".join(ROWS)
    assert logger.rows == 2


def test_layout_follows_the_configuration(tmp_path: Path) -> None:
    config = DisplacementsConfig(
        file=DisplacementFileConfig(
            path=tmp_path / "log*.csv",
            encoding="cp932",
            delimiter=";",
            decimal=",",
            header="日時",
            unit_row=True,
            time_columns=[1, 2],
            time_format="%Y/%m/%d %H:%M:%S",
            time_zone="Asia/Tokyo",
        ),
        channels=[
            DisplacementChannelConfig(name="z", column=5, scale_um=-1000.0),
            DisplacementChannelConfig(name="x1", column="変位X"),
        ],
    )
    logger = csv(config)
    logger.step(0.0)
    assert logger.path == tmp_path / "log0001.csv"
    expected = "日時;Time1;変位X;-;z\r\n;;um;;mm\r\n2024/03/01;17:00:00;0,500;;0,002\r\n"
    assert logger.path.read_bytes() == expected.encode("cp932")


def test_truncated_file_begins_again(tmp_path: Path) -> None:
    logger = csv(displacements(tmp_path), fault(FaultKind.CSV_TRUNCATED, 30.0))
    logger.step(29.0)
    assert logger.path.read_bytes() == HEAD + ROWS[0]
    logger.step(30.0)
    assert logger.path.read_bytes() == b""
    logger.step(60.0)
    assert logger.path.read_bytes() == HEAD + ROWS[1]


def test_rotated_file_is_moved_away(tmp_path: Path) -> None:
    logger = csv(displacements(tmp_path), fault(FaultKind.CSV_ROTATED, 30.0))
    logger.step(60.0)
    assert (tmp_path / "displacements.csv.1").read_bytes() == HEAD + ROWS[0]
    assert (tmp_path / "displacements.csv").read_bytes() == HEAD + ROWS[1]
