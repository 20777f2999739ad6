"""Accelerometer recordings: CSV and every WAV form that is read, and what is refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from drivers.files.accelerometer_recording import AccelerometerFileError, read_acceleration

SHARES = 0.5 * np.sin(np.arange(500) * 0.31)


def wav(path: Path, kind: int, bits: int, data: bytes, channels: int = 1, extra: bytes = b"") -> Path:
    frame = channels * bits // 8
    head = struct.pack("<HHIIHH", kind, channels, 6400, 6400 * frame, frame, bits) + extra
    body = b"fmt " + struct.pack("<I", len(head)) + head + b"LIST" + struct.pack("<I", 3) + b"abc\0"
    body += b"data" + struct.pack("<I", len(data)) + data
    path.write_bytes(b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WAVE" + body)
    return path


def packed_24(samples: np.ndarray) -> bytes:
    return b"".join(struct.pack("<i", value)[:3] for value in samples.tolist())


@pytest.mark.parametrize(
    ("kind", "bits", "data"),
    [
        (1, 16, np.rint(SHARES * 2**15).astype("<i2").tobytes()),
        (1, 24, packed_24(np.rint(SHARES * 2**23).astype(np.int64))),
        (1, 32, np.rint(SHARES * 2**31).astype("<i4").tobytes()),
        (3, 32, SHARES.astype("<f4").tobytes()),
        (3, 64, SHARES.astype("<f8").tobytes()),
    ],
)
def test_wav_forms(tmp_path: Path, kind: int, bits: int, data: bytes) -> None:
    found = read_acceleration(wav(tmp_path / "a.wav", kind, bits, data), full_scale_m_s2=50.0)
    assert found.sample_rate_hz == 6400.0
    assert found.acceleration_m_s2 == pytest.approx(50.0 * SHARES, abs=50.0 * 2.0**-15)


def test_csv_with_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{i / 6400:.7f};{share:.6f}".replace(".", ",") for i, share in enumerate(SHARES)]
    path.write_text("\r\n".join(['"Time_s";"Acceleration_m_s2"', *rows]))
    assert read_acceleration(path).acceleration_m_s2 == pytest.approx(SHARES, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda rows: rows[:100] + rows[140:], "a.csv:102: the time moves by"),
        (lambda rows: [*rows[:50], "0.1,abc", *rows[51:]], "a.csv:52: '0.1,abc' are no two numbers"),
        (lambda rows: [*rows[:50], rows[50].split(",")[0] + ",nan", *rows[51:]], "a.csv:52: a value is not finite"),
        (lambda rows: rows[:5], "too short"),
        (lambda rows: [rows[0]] * 100, "do not ascend"),
    ],
)
def test_csv_refusals(tmp_path: Path, change: object, sentence: str) -> None:
    rows = [f"{i / 6400:.7f},{share:.6f}" for i, share in enumerate(SHARES)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time_s,acceleration_m_s2", *change(rows)]))
    with pytest.raises(AccelerometerFileError) as refused:
        read_acceleration(path)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "bits", "sentence"),
    [(1, 0, "contradicts itself (1 channels, 0 bits)"), (2, 4, "WAV format 2 with 4 bits cannot be read")],
)
def test_wav_refusals(tmp_path: Path, kind: int, bits: int, sentence: str) -> None:
    """Samples without a bit divided by zero."""
    with pytest.raises(AccelerometerFileError) as refused:
        read_acceleration(wav(tmp_path / "a.wav", kind, bits, bytes(400)))
    assert sentence in str(refused.value)
