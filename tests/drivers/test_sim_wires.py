"""The simulated LATSIS lines: bytes read back from the pty and decoded by hand."""

import errno
import os
import select
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from left_behind import descriptors
from scripted_machine import ScriptedMachine, configuration

from config.schema.temperatures import LineConfig
from drivers.sim.faults import Fault, FaultKind
from drivers.sim.wires.latsis_encoding import LineTransmitter, checksum, encode_frame
from drivers.sim.wires.latsis_wire import LatsisWires

BARE_CYCLE = b"04194\r\n030193\r\n02192\r\n01191\r\n"
"""Sensors 4, 3 (infrared, four digits), 2 and 1 of the line `spindle`, which read 190h plus their ID."""


def codes(sensor_ids: Sequence[int]) -> list[int]:
    return [0x190 + sensor_id for sensor_id in sensor_ids]


def transmitter(*faults: Fault, read: Callable[[Sequence[int]], list[int]] = codes, **line: Any) -> LineTransmitter:
    config = LineConfig(name="spindle", port="-", chain=["1-4"], **line)
    devices = {1: "TMP102", 2: "TMP102", 3: "MLX90615", 4: "TMP102"}
    return LineTransmitter(config, devices, read, faults=faults, seed=5)


def fault(kind: FaultKind, at_s: float = 0.0, **more: Any) -> Fault:
    return Fault(kind=kind, at_s=at_s, **({"target": "spindle"} | more))


class Reader:
    """Opens a port as a program would, without waiting for bytes."""

    def __init__(self, link: Path) -> None:
        self.descriptor = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def read(self) -> bytes:
        """Everything that is there."""
        data = b""
        while select.select([self.descriptor], [], [], 0.05)[0]:
            piece = os.read(self.descriptor, 65536)
            if not piece:
                break
            data += piece
        return data

    def close(self) -> None:
        os.close(self.descriptor)


@pytest.fixture
def wires(tmp_path: Path) -> Iterator[Callable[..., LatsisWires]]:
    opened: list[LatsisWires] = []

    def build(*faults: Fault) -> LatsisWires:
        wires = LatsisWires(ScriptedMachine(), configuration(tmp_path).temperatures, tmp_path, faults=faults)
        wires.open()
        opened.append(wires)
        return wires

    yield build
    for each in opened:
        each.close()


# Frames


def test_frames_of_the_two_profiles() -> None:
    bare = LineConfig(name="a", port="-", chain=[1]).frame_grammar
    checked = LineConfig(name="a", port="-", chain=[1], profile="checked").frame_grammar
    assert encode_frame(bare, 0xC8, 3, 0x190) == b"C8190\r\n"
    assert encode_frame(checked, 0xC8, 3, 0x190) == b":0C8,190,00*FD\r\n"


def test_checksums_by_their_known_values() -> None:
    assert checksum("crc8", b"123456789") == 0xF4
    assert checksum("sum8", b"123456789") == 0xDD
    assert (checksum("lrc8", b"123456789") + 0xDD) % 256 == 0


def test_negative_and_extended_registers() -> None:
    def below_zero(ids: Sequence[int]) -> list[int]:
        return [0xE70] * len(ids)

    assert transmitter(read=below_zero).advance(9.9).startswith(b"04E70\r\n")
    assert transmitter(read=below_zero, extended_mode=True).advance(9.9).startswith(b"041E70\r\n")


# Pacing


def test_bytes_leave_at_the_baud_rate() -> None:
    line = transmitter(baud=1000)
    arrived = b""
    for step in range(1, 200):
        arrived += line.advance(step * 0.01)
        assert len(arrived) == min(step, len(BARE_CYCLE))
    assert arrived == BARE_CYCLE


def test_every_cycle_is_sent_once_however_coarse_the_steps() -> None:
    for step_s in (0.003, 0.6, 6.0, 47.0, 1000.0):
        line = transmitter()
        sent, time_s = b"", 0.0
        while time_s < 1000.0:
            sent += line.advance(time_s)
            time_s += step_s
        sent += line.advance(999.9)
        assert sent == BARE_CYCLE * 100
        assert line.cycles_sent == 100


def test_a_line_that_is_too_slow_for_its_cycle_is_refused() -> None:
    with pytest.raises(ValueError, match=r"line spindle needs 2\.9 s per cycle at 100 baud"):
        transmitter(baud=100, cycle_period_s=2.0)


# Faults


def test_noise_damages_the_share_of_bytes_and_is_the_same_for_the_same_seed() -> None:
    noise = fault(FaultKind.NOISE, at_s=100.0, duration_s=2000.0, amount=0.1)
    line, again = transmitter(noise), transmitter(noise)
    quiet, noisy = line.advance(99.9), line.advance(2099.9)
    assert quiet == BARE_CYCLE * 10
    damaged = sum(a != b for a, b in zip(noisy, BARE_CYCLE * 200, strict=True))
    assert 0.07 < damaged / len(noisy) < 0.13
    assert b"".join(again.advance(t / 10) for t in range(21000)) == quiet + noisy
    assert line.advance(2199.9) == BARE_CYCLE * 10
    assert line.cycles_sent == 220
    assert 150 < line.cycles_disturbed <= 200


def test_a_dead_line_is_silent_and_counts_no_cycle() -> None:
    line = transmitter(fault(FaultKind.DEAD_LINE, at_s=10.0, duration_s=20.0))
    assert line.advance(39.9) == BARE_CYCLE * 2
    assert (line.cycles_sent, line.cycles_disturbed) == (2, 2)


def test_a_renumbered_line_has_one_node_less_and_the_others_moved_up() -> None:
    line = transmitter(fault(FaultKind.RENUMBERED, at_s=10.0, duration_s=10.0, amount=2.0))
    assert line.advance(9.9) == BARE_CYCLE
    assert line.advance(19.9) == b"03194\r\n020193\r\n01191\r\n"
    assert line.advance(29.9) == BARE_CYCLE


def test_reset_nodes_read_zero_but_infrared_sensors_do_not() -> None:
    assert transmitter(fault(FaultKind.RESET_BURST)).advance(9.9) == b"04000\r\n030193\r\n02000\r\n01000\r\n"
    assert transmitter(fault(FaultKind.RESET_BURST, target=2)).advance(9.9) == BARE_CYCLE.replace(b"192", b"000")


def test_a_stuck_sensor_repeats_and_then_follows_again() -> None:
    level = iter(range(100))

    def rising(ids: Sequence[int]) -> list[int]:
        return [next(level)] * len(ids)

    line = transmitter(fault(FaultKind.STUCK_SENSOR, at_s=10.0, duration_s=25.0, target=4), read=rising)
    values = [line.advance(10.0 * k + 9.9)[:14] for k in range(6)]
    assert [int(v[2:5], 16) for v in values] == [0, 1, 1, 1, 4, 5]
    assert [int(v[9:13], 16) for v in values] == [0, 1, 2, 3, 4, 5]


# Ports


def test_what_nobody_reads_is_lost_and_never_stops_the_line(tmp_path: Path, wires: Callable[..., LatsisWires]) -> None:
    lines = wires()
    for hour in range(1, 25):
        lines.step(hour * 3600.0 - 0.1)
    assert lines.bytes_dropped["spindle"] == 24 * 360 * len(BARE_CYCLE)
    reader = Reader(tmp_path / "spindle.tty")
    lines.step(24 * 3600.0 + 9.9)
    assert reader.read() == BARE_CYCLE
    reader.close()
    lines.step(24 * 3600.0 + 19.9)
    again = Reader(tmp_path / "spindle.tty")
    lines.step(24 * 3600.0 + 29.9)
    assert again.read() == BARE_CYCLE
    again.close()


def test_an_unplugged_port_vanishes_hangs_up_and_comes_back(tmp_path: Path, wires: Callable[..., LatsisWires]) -> None:
    lines = wires(fault(FaultKind.UNPLUGGED, at_s=15.0, duration_s=10.0))
    link = tmp_path / "spindle.tty"
    reader = Reader(link)
    lines.step(9.9)
    assert reader.read() == BARE_CYCLE
    lines.step(15.0)
    assert not link.is_symlink()
    assert (tmp_path / "column.tty").exists()
    with pytest.raises(OSError) as raised:
        data = os.read(reader.descriptor, 100)
        raise OSError(errno.EIO, "end of file") if not data else AssertionError(data)
    assert raised.value.errno == errno.EIO
    reader.close()
    lines.step(24.9)
    assert not link.is_symlink()
    lines.step(25.0)
    reader = Reader(link)
    lines.step(39.9)
    assert reader.read() == BARE_CYCLE
    reader.close()
    assert lines.cycles_sent["spindle"] == 3


def test_close_takes_the_ports_away_and_leaks_no_descriptor(tmp_path: Path) -> None:
    lines = LatsisWires(ScriptedMachine(), configuration(tmp_path).temperatures, tmp_path / "ports")
    lines.open()
    ports = sorted((tmp_path / "ports").iterdir())
    assert [port.name for port in ports] == ["column.tty", "spindle.tty"]
    devices = [str(port.readlink()) for port in ports]
    assert leading_to(devices) == sorted(devices), "and the far end alone, by which a reader's absence shows"
    lines.close()
    lines.close()
    assert list((tmp_path / "ports").iterdir()) == []
    assert leading_to(devices) == []


def leading_to(devices: list[str]) -> list[str]:
    return sorted(target for target in descriptors().values() if target.removesuffix(" (deleted)") in devices)
