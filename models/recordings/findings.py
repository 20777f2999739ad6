"""Finds what may be wrong with a recording: sentences that name column and row, and say what to do."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from models.recordings.blocks import contiguous_runs
from models.recordings.dataset import DatasetError, Recording
from models.recordings.displacement_steps import largest_jump, repetition
from models.recordings.exchanged_sensors import Exchange, exchanges
from models.recordings.overlaps import without_overlaps
from models.recordings.plausibility import (
    HIGHEST_DEGC,
    LOWEST_DEGC,
    are_rises,
    impossible_displacements,
    impossible_speeds,
    impossible_temperatures,
)
from models.recordings.sensor_agreement import FEWEST_PARTS, Disagreement, disagreements
from models.records import FloatArray
from models.units import ZERO_CELSIUS_K

SMALLEST_SPAN_UM = 0.5
"""All channels moving less than this while the machine warms are not in micrometres."""
WARMING_K = 2.0
"""A temperature span that moves any machine tool by more than `SMALLEST_SPAN_UM`."""
LARGEST_SPAN_UM = 5000.0
"""A channel that moves more is not in micrometres (no displacement sensor of a nest reaches so far)."""
STILL_UM = 0.1
"""A channel that moves by less, and moves, while the machine warms, is not in micrometres: no sensor is so quiet."""
KELVIN_ABOVE, KELVIN_BELOW = 263.0, 400.0
"""What is no temperature in degC may be one in kelvin between these."""
WITHOUT = "convert it, or take the column out of the map"
BROKEN_FROM = 0.05
"""Where more than this share of values can be degC, and most cannot, the sensor broke: a unit is wrong throughout."""
_UNIT_SAID = "temperature_units: {{{name!r}: {unit}}}"
FEWEST_TURNS = 30.0
"""A spindle that turns, and never faster, is no speed in 1/min [1/min]."""
LIKE_THE_OTHERS_K = 1.0
"""A displacement that begins no farther from all temperatures but one, and ..."""
UNLIKE_THE_OTHERS_K = 3.0
"""... that one, which begins farther from the others, are exchanged."""
FEWEST_LIKE = 3
"""So many other temperatures say what temperatures are like."""
SHORTEST_S = 900.0
"""In less time nothing warms by much: a time that is not in seconds is more likely [s]."""
AT_ONCE_S = 60.0
"""No machine warms by half of all that it does in this time [s]: what takes so many seconds takes minutes."""
FEWEST_AT_ONCE = 4
"""So many rows tell what a temperature does in that time."""
FASTEST_S = 0.5
"""Hardly any logger writes temperatures more often [s]: then, too."""
SHORT_GAP_S = 600.0
"""Gaps are bridged up to this, by a straight line [s]: nothing is said of them."""
CLOCK_CHANGE_S = 3600.0
"""So far a wall clock jumps in spring [s]."""
MOST_NAMED = 3
"""So many recordings are named of which the same is said."""
MOST_AMONG = 12
"""So many sensors are named among which some were exchanged."""
WARMEST_START_DEGC = 50.0
"""Where no temperature is ever below this, they are not in degC: a cold workshop of 10 degC has 50 degF."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that is wrong, or noteworthy, in a recording."""

    severity: Literal["error", "warning"]
    column: str
    """Name of the column; empty when it is about the recording as a whole."""
    row: int | None
    """Row of the file from 1 (without the header), None when it is about the whole column."""
    sentence: str
    columns: int = 1
    """Of so many columns the same is said; `column` names the first of them."""
    missing: int = 0
    """So many values are missing in each of the columns; 0 where it is about something else."""

    def __str__(self) -> str:
        """Return `column <name>, row <n>: <sentence>`."""
        place = [f"column{'s' if self.columns > 1 else ''} {self.column}"] if self.column else []
        place += [f"row {self.row}"] if self.row is not None else []
        return f"{', '.join(place)}: {self.sentence}" if place else self.sentence


def recording_findings(recording: Recording, rows_together: int | None = None) -> tuple[Finding, ...]:
    """Return everything that is wrong or noteworthy in a recording, errors first.

    `recording`: the recording as it was read. `rows_together`: see `require_usable`.
    """
    possible = recording.without_impossible()
    found = [
        *_rows(recording, rows_together),
        *_impossible(recording),
        *_columns(possible, recording, alone=rows_together in (None, recording.rows)),
        *_temperature_units(possible),
        *_displacement_units(possible),
        *_steps(possible),
        *_exchanged(possible),
        *_shortness(possible),
    ]
    return tuple(sorted(_once(found), key=lambda finding: finding.severity != "error"))


def _once(found: Sequence[Finding]) -> list[Finding]:
    """Return findings that say the same of several columns of one row as one that names these columns."""
    alike: dict[tuple[str, int | None, str], list[Finding]] = {}
    for one in found:
        alike.setdefault((one.severity, one.row, one.sentence), []).append(one)
    return [
        replace(of[0], column=_listed([one.column for one in of]), columns=len(of)) if len(of) > 1 else of[0]
        for of in alike.values()
    ]


def require_usable(recording: Recording, rows_together: int | None = None) -> tuple[Finding, ...]:
    """Return the warnings of a recording that training may use.

    Result: gaps, missing values, constant sensors. Raises DatasetError naming every error: fewer rows than variables,
    columns without values, units that cannot be right.

    `recording`: the recording as it was read. `rows_together`: rows of all recordings that are used together with this
    one, which have to be more than the variables; None: it is used alone.
    """
    found = recording_findings(recording, rows_together)
    if errors := [finding for finding in found if finding.severity == "error"]:
        raise DatasetError("\n".join(f"{recording.name}: {finding}" for finding in errors))
    return found


def usable_recordings(
    recordings: Sequence[Recording], *, rows_needed: bool = True
) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings that may be used together, each row once and without values that cannot be, and the warnings.

    Raises DatasetError naming every error of the first recording that has one, see `require_usable`, and where all of
    a recording is in another.

    `rows_needed`: False where they may have fewer rows than variables, as something else is known of these.
    """
    recordings, overlaps = without_overlaps(recordings)
    together = sum(recording.rows for recording in recordings)
    if not rows_needed:
        together = max(together, len(recordings[0].temperature_names) + 1)
    found = [(r.name, finding) for r in recordings for finding in require_usable(r, together)]
    gaps = [(name, finding) for name, finding in found if finding.missing]
    if len(gaps) > MOST_NAMED:
        found = [(name, finding) for name, finding in found if not finding.missing]
    warnings = said_together([(name, str(finding)) for name, finding in found])
    if len(gaps) > MOST_NAMED:
        warnings.append(_gaps(gaps))
    possible = [recording.without_impossible() for recording in recordings]
    exchanged = exchanges(possible)
    known = {sensor for found in exchanged for sensor in (*found.sensors, *found.among)}
    disagreeing = [f"{possible[found.first].name}: {_exchange(possible, found)}" for found in exchanged]
    disagreeing += [
        f"{possible[found.recording].name}: {_disagreement(possible, found)}"
        for found in disagreements(possible, known)
        if np.isfinite(possible[found.recording].temperatures_degc[:, found.sensor]).any()
    ]
    return possible, (*disagreeing, *_rises(possible), *overlaps, *warnings)


def _gaps(gaps: Sequence[tuple[str, Finding]]) -> str:
    """Return one sentence for the missing values of many columns: how many, in which recordings, where most."""
    name, most = max(gaps, key=lambda gap: gap[1].missing)
    of = list(dict.fromkeys(name for name, _ in gaps))
    values = sum(finding.missing * finding.columns for _, finding in gaps)
    return (
        f"{_listed(of)}: {values} values are missing, most in column{'s' * (most.columns > 1)} {most.column} of {name} "
        f"({most.missing}{' each' * (most.columns > 1)}, the first in row {most.row}); rows without them are left out"
    )


def _rises(recordings: Sequence[Recording]) -> list[str]:
    """Return what is said of recordings that hold rises since the start, not temperatures."""
    rises = [one for one in recordings if are_rises(one.temperatures_degc[:, : one.sensors])]
    some = "in these recordings alone; add what each sensor read at the start, as in the others"
    every = "the model goes by changes since a reference alone, also where it tells how far it may be trusted"
    sentence = (
        f"all temperatures begin at 0, so they are rises since the start: {some if rises != recordings else every}"
    )
    return said_together([(one.name, sentence) for one in rises])


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as `1 run` and `3 runs`; plurals end with s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def said_together(sentences: Sequence[tuple[str, str]]) -> list[str]:
    """Return `name: sentence` once for each sentence, with the names of all that it is said of."""
    names: dict[str, list[str]] = {}
    for name, sentence in sentences:
        names.setdefault(sentence, []).append(name)
    return [f"{_listed(of)}: {sentence}" for sentence, of in names.items()]


def _listed(names: Sequence[str], most: int = MOST_NAMED) -> str:
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def _exchange(recordings: Sequence[Recording], found: Exchange) -> Finding:
    """Return what is said of two sensors that were exchanged, or of several of which some were."""
    names = recordings[found.first].temperature_names
    if found.among:
        where = "in this recording alone" if found.alone else "from this recording on"
        sentence = (
            f"some of these temperatures do {where} what others of them do elsewhere: several seem to be exchanged, "
            "which is not told. Look where the cables of all of them go, and exchange the names in the header of the "
            "files that are wrong, or train without those files (--without)"
        )
        return _warning(_listed([names[sensor] for sensor in found.among], MOST_AMONG), None, sentence)
    one, other = (names[sensor] for sensor in found.sensors)
    as_before = f"from this recording on what {other} did before, and {other} what {one} did"
    as_elsewhere = f"in this recording alone what {other} does in the others, and {other} what {one} does"
    does = as_elsewhere if found.alone else as_before
    sentence = (
        f"does {does} ({found.by_k:.2g} K off): the two seem to be exchanged. Look where their cables go, and exchange "
        "the two names in the header of the files that are wrong, or train without those files (--without)"
    )
    return _warning(one, None, sentence)


def _disagreement(recordings: Sequence[Recording], found: Disagreement) -> Finding:
    """Return what is said of a sensor that contradicts the others."""
    recording = recordings[found.recording]
    name = recording.temperature_names[found.sensor]
    advice = "check the sensor, and leave the fields empty where it is wrong, or take it out of the map"
    if found.row is None:
        cut = len(recordings) < FEWEST_PARTS
        where = "in a part of this recording" if cut else "in this recording alone"
        so = ", or is it the only one near something that warmed there alone" if cut else ""
        sentence = (
            f"contradicts the other temperatures by {found.by_k:.2g} K {where}: exchanged, loose or "
            f"mounted elsewhere{so}? {advice[0].upper()}{advice[1:]}"
        )
        return _warning(name, None, sentence)
    sentence = (
        f"stands still from here on for {found.stuck_h:.1f} h while the other temperatures say that it moved by "
        f"{found.by_k:.2g} K; it seems stuck: {advice}"
    )
    return _warning(name, recording.rows_before + found.row + 1, sentence)


def _error(column: str, row: int | None, sentence: str) -> Finding:
    return Finding(severity="error", column=column, row=row, sentence=sentence)


def _warning(column: str, row: int | None, sentence: str) -> Finding:
    return Finding(severity="warning", column=column, row=row, sentence=sentence)


def _rows(recording: Recording, rows_together: int | None) -> Iterator[Finding]:
    variables = len(recording.temperature_names)
    rows = recording.rows if rows_together is None else rows_together
    if rows <= variables:
        needed = f"{counted(rows, 'row')} cannot determine {counted(variables, 'variable')}"
        sentence = f"{needed}; record longer or choose fewer temperatures"
        yield _error("", None, sentence)
        return
    time_s = recording.time_s
    firsts = [first for first, _ in contiguous_runs(time_s, recording.sample_s)[1:]]
    gaps_s = {first: float(time_s[first] - time_s[first - 1]) for first in firsts}
    long = [first for first, gap_s in gaps_s.items() if gap_s > SHORT_GAP_S]
    for first in long:
        if abs(gaps_s[first] - recording.sample_s - CLOCK_CHANGE_S) < 1.0:
            sentence = (
                f"a gap of {gaps_s[first]:g} s before this row; where clocks were set to summer time there, say "
                "time_zone in the map; else nothing is learned from it"
            )
            yield _warning("time", recording.rows_before + first + 1, sentence)
            long = [other for other in long if other != first]
    if long:
        longest = max(long, key=gaps_s.__getitem__)
        all_of = f" ({len(long)} gaps beyond {SHORT_GAP_S / 60.0:g} min, the longest here)" if len(long) > 1 else ""
        sentence = f"a gap of {gaps_s[longest]:g} s before this row{all_of}; nothing is learned from it"
        yield _warning("time", recording.rows_before + longest + 1, sentence)


def _impossible(recording: Recording) -> Iterator[Finding]:
    degc, um = recording.temperatures_degc[:, : recording.sensors], recording.displacements_um
    tables = [
        (recording.temperature_names[: recording.sensors], "degC", degc, impossible_temperatures(degc)),
        (recording.displacement_names, "um", um, impossible_displacements(um)),
    ]
    if (speed_rpm := recording.speed_rpm) is not None:
        tables.append((("spindle speed",), "1/min", speed_rpm[:, None], impossible_speeds(speed_rpm)[:, None]))
    for names, unit, table, wrong in tables:
        for column in np.flatnonzero(wrong.any(axis=0)):
            row, count = int(np.argmax(wrong[:, column])), int(wrong[:, column].sum())
            others = f" ({count} such values, the first here)" if count > 1 else ""
            sentence = (
                f"{_as_read(table[row, column], unit)} cannot be{others} and counts as missing; check the sensor and "
                "its wire, and leave the field empty where a value is wrong"
            )
            yield _warning(names[column], recording.rows_before + row + 1, sentence)


def _as_read(value: float, unit: str) -> str:
    """Return a value with its unit, a temperature also as the file has it where it is round in another unit there."""
    said = f"{value + 0.0:.6g} {unit}"
    for other, there in (("degF", 1.8 * value + 32.0), ("K", value + ZERO_CELSIUS_K)) if unit == "degC" else ():
        if abs(there - round(there)) < 1e-6 < abs(value - round(value)):
            return f"{said} ({there:.6g} {other})"
    return said


def _columns(recording: Recording, read: Recording, *, alone: bool) -> Iterator[Finding]:
    """Yield what is wrong with columns.

    `read`: with the impossible values, of which `_impossible` tells. `alone`: no other recording is used with it, in
    which a temperature that has no value here may have some.
    """
    speed_rpm = recording.speed_rpm
    if speed_rpm is not None and len(speed_rpm) and not np.isfinite(speed_rpm).any():
        sentence = "no value at all, which is not standstill; take the column out of the file or of the map"
        yield _error("spindle speed", None, sentence)
    elif speed_rpm is not None and 0.0 < (fastest := float(np.nanmax(np.abs(speed_rpm), initial=0.0))) < FEWEST_TURNS:
        sentence = (
            f"never above {fastest:.4g}, which warms no spindle: is it in thousands, or in another unit? Say "
            "speed_unit (krpm, 1/s or rad/s) in the map; where it is right, or no speed, take `speed` out of the map"
        )
        yield _error("spindle speed", None, sentence)
    elif read.speed_rpm is not None:
        yield from _missing("spindle speed", read.speed_rpm, recording.rows_before)
    columns = [
        *zip(recording.temperature_names, recording.temperatures_degc.T, read.temperatures_degc.T, strict=True),
        *zip(recording.displacement_names, recording.displacements_um.T, read.displacements_um.T, strict=True),
    ]
    for name, column, as_read in columns:
        missing = ~np.isfinite(column)
        if len(column) and missing.all() and not alone and name in recording.temperature_names[: recording.sensors]:
            sentence = (
                "no value at all in this recording, which is not trained on while the column is used; look at its "
                "sensor, and leave this recording out or take the column out of the map, whichever costs less"
            )
            yield _warning(name, None, sentence)
            continue
        if not len(column) or missing.all():
            yield _error(name, None, "no value at all; take the column out of the map, or leave this recording out")
            continue
        yield from _missing(name, as_read, recording.rows_before)
        known = column[~missing]
        if len(known) > 2 and known.min() == known.max():
            sentence = f"constant at {known[0]:g} over the whole recording; is the sensor connected?"
            yield _warning(name, None, sentence)


def _missing(name: str, as_read: FloatArray, rows_before: int) -> Iterator[Finding]:
    """Yield how many values of a column the file does not have."""
    empty = ~np.isfinite(as_read)
    if empty.any():
        many = f"{empty.sum()} values are missing, the first here; rows without them are left out"
        one = "1 value is missing, here; the row without it is left out"
        said = _warning(name, rows_before + int(np.argmax(empty)) + 1, one if empty.sum() == 1 else many)
        yield replace(said, missing=int(empty.sum()))


def _temperature_units(recording: Recording) -> Iterator[Finding]:
    for name, column in zip(
        recording.temperature_names[: recording.sensors], recording.temperatures_degc.T, strict=False
    ):
        known = column[np.isfinite(column)]
        if not len(known):
            continue
        median = float(np.median(known))
        can_be = float(((known >= LOWEST_DEGC) & (known <= HIGHEST_DEGC)).mean())
        if BROKEN_FROM < can_be <= 0.5:
            share = f"{1.0 - can_be:.0%} of its values cannot be degC, such as {median:.4g}"
            advice = "where its sensor broke, leave those fields empty, or leave this recording out"
            yield _error(name, None, f"{share}: {advice}; else {WITHOUT}")
        elif median > HIGHEST_DEGC:
            kelvin = float(np.quantile(known, 0.05)) > KELVIN_ABOVE and median < KELVIN_BELOW
            unit = "kelvin" if kelvin else "tenths of a degree, raw counts or an open wire"
            advice = f"say {_UNIT_SAID.format(name=name, unit='K')} in the map" if kelvin else WITHOUT
            yield _error(name, None, f"a median of {median:.4g} cannot be degC; it looks like {unit}: {advice}")
        elif median < LOWEST_DEGC:
            sentence = f"a median of {median:.4g} cannot be degC; is it connected? Else take it out of the map"
            yield _error(name, None, sentence)
    yield from _fahrenheit(recording)
    yield from _fahrenheit_among_others(recording)


def _fahrenheit(recording: Recording) -> Iterator[Finding]:
    temperatures = recording.temperatures_degc[:, : recording.sensors]
    degc = np.where(np.isfinite(temperatures), temperatures, np.inf)
    if not degc.size or not WARMEST_START_DEGC < (lowest := float(degc.min())) < HIGHEST_DEGC:
        return
    row, column = np.unravel_index(int(np.argmin(degc)), degc.shape)
    sentence = (
        f"{lowest:.4g} is the lowest of all temperatures, and no workshop is so warm; it looks like degF: say "
        f"{_UNIT_SAID.format(name='*', unit='degF')} in the map, where all of them are in degF"
    )
    yield _error(recording.temperature_names[int(column)], recording.rows_before + int(row) + 1, sentence)


def _fahrenheit_among_others(recording: Recording) -> Iterator[Finding]:
    """Yield temperatures that stay far above all others, and begin where the others do when they are degF."""
    names, degc = recording.temperature_names[: recording.sensors], recording.temperatures_degc[:, : recording.sensors]
    starts = np.array([column[np.isfinite(column)][:1].sum() for column in degc.T])
    high = starts > WARMEST_START_DEGC
    if not high.any() or len(starts) - high.sum() < max(FEWEST_LIKE, high.sum()):
        return
    low_degc, high_degc = float(starts[~high].min()), float(starts[~high].max())
    for at in np.flatnonzero(high).tolist():
        meant = (starts[at] - 32.0) / 1.8
        likely = low_degc - LIKE_THE_OTHERS_K <= meant <= high_degc + LIKE_THE_OTHERS_K
        if likely and high_degc - low_degc < UNLIKE_THE_OTHERS_K and np.nanmin(degc[:, at]) > WARMEST_START_DEGC:
            sentence = (
                "stays far above all others, and begins where they do if it is in degF: where it is, say "
                f"{_UNIT_SAID.format(name=names[at], unit='degF')} in the map (of one recording alone: convert it)"
            )
            yield _warning(names[at], None, sentence)


def _displacement_units(recording: Recording) -> Iterator[Finding]:
    spans_um = _spans(recording.displacement_names, recording.displacements_um)
    for name, span_um in spans_um.items():
        if span_um > LARGEST_SPAN_UM:
            sentence = f"moves by {span_um:.4g}, too far for micrometres; it looks like nanometres or raw counts"
            yield _error(name, None, sentence)
    names, degc = recording.temperature_names[: recording.sensors], recording.temperatures_degc[:, : recording.sensors]
    warmed_k = max(_spans(names, degc).values(), default=0.0)
    if warmed_k > WARMING_K and spans_um and (widest := max(spans_um.values())) < SMALLEST_SPAN_UM:
        name = max(spans_um, key=lambda channel: spans_um[channel])
        sentence = (
            f"no displacement moves by more than {widest:.3g} while temperatures change by {warmed_k:.3g} K; "
            "that looks like millimetres or inches; say which in the map: displacement_units (of one recording alone: "
            "convert its columns to um). Where they are micrometres, nothing "
            "can be learned from this recording: record one in which the axis warms"
        )
        yield _error(name, None, sentence)
        return
    for name, span_um in spans_um.items():
        if warmed_k > WARMING_K and 0.0 < span_um < STILL_UM:
            sentence = (
                f"moves by no more than {span_um:.3g} while temperatures change by {warmed_k:.3g} K; that looks like "
                f"millimetres or inches; say so in the map: displacement_units: {{{name!r}: mm}} (or in). Else leave "
                "the channel out"
            )
            yield _warning(name, None, sentence)


def _steps(recording: Recording) -> Iterator[Finding]:
    """Yield displacements that jump, or repeat what a probe measured last."""
    for name, um in zip(recording.displacement_names, recording.displacements_um.T, strict=True):
        if (repeated := repetition(recording.time_s, um)) is not None:
            sentence = (
                f"repeats its value for {repeated.for_s / 60.0:.0f} min as a rule, and then steps by "
                f"{repeated.step_um:.2g} um: where a probe measures now and then, leave the fields between empty, or "
                "the model is fitted on what was measured so long before"
            )
            yield _warning(name, recording.rows_before + repeated.row + 1, sentence)
        elif (jump := largest_jump(recording.time_s, um, recording.speed_rpm)) is not None:
            sentence = (
                f"jumps by {jump.by_um:.3g} um from the row before to this one, while the speed stays the same, and "
                "goes on from there: was the sensor set to zero, knocked or mounted anew? Cut the file there, or the "
                "model is fitted on the jump"
            )
            yield _warning(name, recording.rows_before + jump.row + 1, sentence)


def _exchanged(recording: Recording) -> Iterator[Finding]:
    """Yield a displacement that begins as the temperatures do, where one of the temperatures does not."""
    names, degc = recording.temperature_names[: recording.sensors], recording.temperatures_degc[:, : recording.sensors]
    if len(names) <= FEWEST_LIKE or are_rises(degc):
        return
    starts = np.array([column[np.isfinite(column)][:1].sum() for column in degc.T])
    odd = int(np.argmax(np.abs(starts - np.median(starts))))
    others = np.delete(starts, odd)
    low, high = float(others.min()), float(others.max())
    if max(low - starts[odd], starts[odd] - high) < UNLIKE_THE_OTHERS_K or high - low > UNLIKE_THE_OTHERS_K:
        return
    for name, um in zip(recording.displacement_names, recording.displacements_um.T, strict=True):
        known = um[np.isfinite(um)]
        as_degc = len(known) > 0 and low - LIKE_THE_OTHERS_K <= known[0] <= high + LIKE_THE_OTHERS_K
        if as_degc and 0.0 < np.ptp(known) < HIGHEST_DEGC:
            sentence = (
                f"begins at what the temperatures begin at, and temperature {names[odd]} does not: are the two columns "
                "exchanged? Look at their names in the file, or at the map"
            )
            yield _warning(name, None, sentence)


def _shortness(recording: Recording) -> Iterator[Finding]:
    """Yield a time that is hardly in seconds: too little of it for the warming, or rows that follow too fast."""
    span_s = float(np.ptp(recording.time_s)) if recording.rows > 1 else SHORTEST_S
    warmed_k = max(_spans(recording.temperature_names, recording.temperatures_degc).values(), default=0.0)
    advice = "where the time counts minutes, hours or days, say so in the map: time_unit: min, h or d"
    if (span_s < SHORTEST_S and warmed_k > WARMING_K) or recording.sample_s < FASTEST_S:
        rows = counted(recording.rows, "row")
        sentence = f"{rows} in {span_s:.3g} s, in which temperatures change by {warmed_k:.3g} K: {advice}"
        yield _warning("time", None, sentence)
    elif _warms_at_once(recording):
        sentence = f"most temperatures change by half of all that they do within {AT_ONCE_S:g} s: {advice}"
        yield _warning("time", None, sentence)


def _warms_at_once(recording: Recording) -> bool:
    """Return whether most of the temperatures that move much do half of it in less time than a machine needs."""
    rows = int(AT_ONCE_S / recording.sample_s) if recording.rows > 1 else 0
    if not FEWEST_AT_ONCE <= rows < recording.rows:
        return False
    soon = recording.time_s[rows:] - recording.time_s[:-rows] <= 1.01 * AT_ONCE_S
    at_once = []
    for column in recording.temperatures_degc[:, : recording.sensors].T:
        known = column[np.isfinite(column)]
        if len(known) and np.ptp(known) > 2.0 * WARMING_K:
            changes_k = np.nan_to_num(np.abs(column[rows:] - column[:-rows])[soon])
            at_once.append(float(changes_k.max(initial=0.0)) >= 0.5 * float(np.ptp(known)))
    return 2 * sum(at_once) > len(at_once)


def _spans(names: tuple[str, ...], table: FloatArray) -> dict[str, float]:
    """Return how far each column with a value moves."""
    known = {name: column[np.isfinite(column)] for name, column in zip(names, table.T, strict=True)}
    return {name: float(np.ptp(values)) for name, values in known.items() if len(values)}
