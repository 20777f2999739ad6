"""Reads an accelerometer recording: CSV (`time_s,acceleration_m_s2`) or WAV (PCM or float)."""

import csv
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from config.files import read_whole
from drivers.contract import FatalDriverError
from drivers.files.table import columns, number
from models.records import FloatArray

COLUMNS = ("time_s", "acceleration_m_s2")
FEWEST_SAMPLES = 16
LARGEST_RECORDING = 2**30
"""Three hours of 24 bit at 25.6 kHz are less [byte]."""
PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
MOST_AT_FULL_SCALE = 3
"""More samples at the ends of the number range than this are a clipped recording."""


class AccelerometerFileError(FatalDriverError):
    """A recording cannot be read; the text begins with the file, and the line where there is one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationRecording:
    """One channel of acceleration, evenly sampled."""

    sample_rate_hz: float
    start_s: float
    """Time of the first sample [s]."""
    acceleration_m_s2: FloatArray
    """Shape (n,) [m/s^2]; a WAV without a scale is in shares of full scale."""


def read_acceleration(path: Path, full_scale_m_s2: float | None = None) -> AccelerationRecording:
    """Read a recording; `full_scale_m_s2` is what a WAV's full scale means. Raises `AccelerometerFileError`."""
    try:
        content = read_whole(path, LARGEST_RECORDING)
    except OSError as error:
        raise AccelerometerFileError(f"{path}: cannot be opened ({error.strerror})") from error
    if content[:4] == b"RIFF" and content[8:12] == b"WAVE":
        return _wav(path, content, 1.0 if full_scale_m_s2 is None else full_scale_m_s2)
    if path.suffix.lower() == ".wav":
        raise AccelerometerFileError(f"{path}: is not a WAV file (RIFF WAVE); export it as PCM or float WAV, or as CSV")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise AccelerometerFileError(f"{path}: is neither WAV nor UTF-8 text; export CSV or WAV") from error
    return _csv(path, text)


def _csv(path: Path, text: str) -> AccelerationRecording:
    lines = text.splitlines()
    try:
        names, delimiter = columns(lines[0] if lines else "")
    except csv.Error as error:
        raise AccelerometerFileError(f"{path}: is not CSV ({error})") from error
    if missing := [name for name in COLUMNS if name not in names]:
        raise AccelerometerFileError(
            f"{path}:1: there is no column {' and '.join(missing)}; a recording has the header {','.join(COLUMNS)}"
        )
    time_place, value_place = names.index(COLUMNS[0]), names.index(COLUMNS[1])
    rows = [(place, line.split(delimiter)) for place, line in enumerate(lines[1:], start=2) if line.strip()]
    if len(rows) < FEWEST_SAMPLES:
        raise AccelerometerFileError(f"{path}: holds {len(rows)} samples; this is too short to say anything")
    times = np.empty(len(rows))
    values = np.empty(len(rows))
    for place, (line_number, fields) in enumerate(rows):
        try:
            times[place] = number(fields[time_place], delimiter)
            values[place] = number(fields[value_place], delimiter)
        except (ValueError, IndexError):
            raise AccelerometerFileError(
                f"{path}:{line_number}: {delimiter.join(fields)[:60]!r} are no two numbers; is the row cut off?"
            ) from None
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        bad = int(np.flatnonzero(~(np.isfinite(times) & np.isfinite(values)))[0])
        raise AccelerometerFileError(f"{path}:{rows[bad][0]}: a value is not finite; cut the recording there")
    return AccelerationRecording(
        sample_rate_hz=_rate(path, times, [number for number, _ in rows]),
        start_s=float(times[0]),
        acceleration_m_s2=values,
    )


def _rate(path: Path, times: FloatArray, numbers: list[int]) -> float:
    """Return the sampling rate; times may be rounded, but not have gaps."""
    period_s = float(times[-1] - times[0]) / (len(times) - 1)
    if not period_s > 0.0:
        raise AccelerometerFileError(f"{path}: the times do not ascend; sort the rows")
    steps = np.diff(times)
    odd = np.flatnonzero((steps < 0.0) | (np.abs(steps - np.median(steps)) > 0.9 * period_s))
    if len(odd):
        raise AccelerometerFileError(
            f"{path}:{numbers[int(odd[0]) + 1]}: the time moves by {steps[odd[0]]:g} s where {period_s:g} s are "
            "usual; samples are missing or doubled: cut the recording there"
        )
    return 1.0 / period_s


def _wav(path: Path, content: bytes, full_scale_m_s2: float) -> AccelerationRecording:
    chunks = _chunks(content)
    if b"fmt " not in chunks or b"data" not in chunks or len(chunks[b"fmt "]) < 16:
        raise AccelerometerFileError(f"{path}: the WAV file has no format or no data; it was not closed properly")
    kind, channels, rate, _, frame, bits = struct.unpack("<HHIIHH", chunks[b"fmt "][:16])
    if kind == EXTENSIBLE and len(chunks[b"fmt "]) >= 26:
        kind = struct.unpack("<H", chunks[b"fmt "][24:26])[0]
    if kind not in (PCM, FLOAT):
        raise _unreadable(path, kind, bits)
    if channels < 1 or rate < 1 or not 0 < frame == channels * bits // 8:
        raise AccelerometerFileError(f"{path}: the WAV header contradicts itself ({channels} channels, {bits} bits)")
    data = chunks[b"data"]
    shares = _shares(path, kind, bits, data[: len(data) // frame * frame])[::channels]
    if len(shares) < FEWEST_SAMPLES:
        raise AccelerometerFileError(f"{path}: holds {len(shares)} samples; this is too short to say anything")
    if kind == PCM and int(np.sum(np.abs(shares) >= 1.0 - 2.0 ** (1 - bits))) > MOST_AT_FULL_SCALE:
        raise AccelerometerFileError(
            f"{path}: the recording is clipped (samples at full scale); lower the gain and record again"
        )
    return AccelerationRecording(sample_rate_hz=float(rate), start_s=0.0, acceleration_m_s2=shares * full_scale_m_s2)


def _chunks(content: bytes) -> dict[bytes, bytes]:
    chunks: dict[bytes, bytes] = {}
    place = 12
    while place + 8 <= len(content):
        name, size = content[place : place + 4], struct.unpack("<I", content[place + 4 : place + 8])[0]
        chunks.setdefault(name, content[place + 8 : place + 8 + size])
        place += 8 + size + size % 2
    return chunks


def _shares(path: Path, kind: int, bits: int, data: bytes) -> FloatArray:
    """Return the samples as shares of full scale, -1 to 1."""
    if kind == FLOAT and bits in (32, 64):
        samples = np.frombuffer(data, dtype=f"<f{bits // 8}").astype(np.float64)
        if not np.all(np.isfinite(samples)):
            raise AccelerometerFileError(f"{path}: a sample is not finite; cut the recording there")
        return samples
    if kind == PCM and bits in (16, 32):
        return np.frombuffer(data, dtype=f"<i{bits // 8}") / 2.0 ** (bits - 1)
    if kind == PCM and bits == 24:
        octets = np.frombuffer(data, dtype=np.uint8).reshape(-1, 3).astype(np.int32)
        return ((octets[:, 0] << 8 | octets[:, 1] << 16 | octets[:, 2] << 24) >> 8) / 2.0**23
    raise _unreadable(path, kind, bits)


def _unreadable(path: Path, kind: int, bits: int) -> AccelerometerFileError:
    return AccelerometerFileError(
        f"{path}: WAV format {kind} with {bits} bits cannot be read; export 16, 24 or 32 bit PCM, or float"
    )


__all__ = ["AccelerationRecording", "AccelerometerFileError", "read_acceleration"]
