"""Proposes the map of a recording from the names of its columns and its first rows; a person checks it.

A column is what its name says: a unit in it, else a word, else a letter with a number; of a length in mm or in its
values say whether an axis can stand there. What these do not tell is left out and named, never guessed: a wrong column
in a model is worse than a missing one.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby, pairwise
from statistics import median
from typing import Any

import yaml

from config.recordings.column_units import RPM_PER_UNIT, TIMES, has_thousands, unit_in, unit_of
from config.recordings.recording_map import MILLISECONDS_FROM, UM_PER_UNIT, RecordingMap, are_days, fits
from models.recordings.plausibility import HIGHEST_DEGC, LOWEST_DEGC

_DATE = re.compile(r"\b(date|datum|tag|day|data|dato|fecha)\b|日付|年月日")
_TIME = re.compile(
    r"\b(time|\w*zeit|timestamp|zeitstempel|datetime|utc|clock|t|temps|tiempo|tempo|tijd|elapsed|minut(e|en|es|os)|sec(ond)?s?|sek(unden?)?)\b"
    r"|\b(heure|hora|ora|orario)\b|日時|時刻|時間"
)
_IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$")
_NUMBERED_T = re.compile(r"t[ _]?\d")
"""A temperature: where no column is the time, none of these is."""
_SPEED = re.compile(
    r"rpm|1/min|min-1|min\^-1|u/min|r/min|drehzahl|spindle.?speed|speed|回転"
    r"|\b(giri|tr|tours?|rev|obr|ot|omw|varv|vueltas?)\s*/\s*min|\bgiri\b|vitesse|velocidad|velocit|toerental|varvtal"
)
_OF_SPINDLE = re.compile(r"spind|drehzahl|主軸|rpm|/\s*min|mandr|broche|husillo")
_NO_TURNS = re.compile(r"%|[\[(]\s*m{0,2}/\s*(s|min)\b")
"""A load, a feed and a draught of air have a speed, too."""
_DEGC = re.compile(r"°\s*c\b|deg\s*_?c\b|℃|\[c\]|\(c\)|celsius|grad c")
_DEGF = re.compile(r"°\s*f\b|deg\s*_?f\b|℉|\[f\]|\(f\)|fahrenheit")
_KELVIN = re.compile(r"\[k\]|\(k\)|\bkelvin\b")
_ABSOLUTE_K = 200.0
"""Rises in kelvin are rises in degrees Celsius; where a machine stands, kelvin are more than that."""
_UM = re.compile(r"[µμ]m|\bum\b|_um$|micron|micromet")
_COARSE = {"mm": re.compile(r"\bmm\b|_mm$"), "in": re.compile(r"[\[(]\s*in\s*[\])]|\binch(es)?\b|_in(ch)?$")}
_WITH_COARSE = re.compile(r"[\s_]*[\[(]?\s*\b(mm|in|inch(es)?)\b\s*[\])]?$|_(mm|in|inch)$")
"""What the name of a channel loses: the map turns it into micrometres."""
_PLACE = re.compile(r"\bpos|\bach?se|\baxis|\blage\b|位置")
SMALL_UM = 1000.0
"""No axis moves and stays so near to zero ..."""
FEWEST_SMALL = 10
"""... at so many different places."""
_MOVES = re.compile(
    r"変位|displace|\bdisp|taster|verlagerung|deviation|thermal.?error|\bweg\b|probe|^d[xyz]|^e[xyz]|^c\d+\b"
)
"""Beside millimetres a displacement says so, or stays small; an axis position is in millimetres, too."""
_OTHER_UNIT = re.compile(r"\bnm\b|\bkw\b|[\[(]\s*[wav]\s*[\])]|%|\bbar\b|\bhz\b|\bl/min\b")
"""One letter is a unit in brackets alone: `Temp A` is a temperature."""
_TEMPERATURE = re.compile(r"温度|temp|thermo|pt ?100+|^tc ?\d+|^rtd|^t[a-z]? ?\d+$|^d?t\d+\b|^t ")
_DISPLACEMENT = re.compile(
    r"変位|displace|\bdisp([xyz]\d*)?\b|verlagerung|deviation|thermal.?error|^weg\b|^[xyzabcuvw] ?\d*$"
    r"|\bd[xyz]\d*$|^e[xyz]\d*$|probe|taster"
)
_OF_12_HOURS = ("%I:%M:%S %p", "%I:%M %p")
_OF_DAY = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M:%S,%f", "%H:%M", *_OF_12_HOURS)
_DATES: tuple[str, ...] = (
    "%d.%m.%Y",
    "%d.%m.%y",
    "%d/%m/%Y",
    "%m/%d/%Y",
    "%Y-%m-%d",
    "%Y/%m/%d",
    "%Y年%m月%d日",
    "%d-%m-%Y",
    "%Y%m%d",
    "%d %b %Y",
    "%d-%b-%Y",
)
_DATES += ("%d-%b-%y", "%d/%m/%y", "%m/%d/%y")
_FORMATS = (
    *(f"{date} {time}" for date in ("%m/%d/%Y", "%m/%d/%y") for time in _OF_12_HOURS),
    *(f"{date} {time}" for date in _DATES for time in _OF_DAY),
)
"""Where a clock has twelve hours, the month is first as a rule."""
_NINES = re.compile(r"-?9{3,}([.,](9+|0+))?|-?3276[78]([.,]0+)?")
"""What loggers write where they have no value."""
_NO_NUMBER = re.compile(r"#|[+-]?1[.,]#(IND|QNAN|SNAN|INF)")
LARGEST = 1e9
"""No sensor says more, in whatever unit: what is written so has overflown."""
FAR_OFF = 3.0
"""So many times as far from all other values of a column as these from each other: then it is none."""
FEWEST_NUMBERED = 4
"""So many columns that are called by a number are named together."""
JAPANESE = ("温度", "変位", "時刻", "日時", "回転")
"""Words of recordings, by which their encoding is told."""
_WITHOUT_THOUSANDS = "a mark separates thousands; export the file without such marks"
_LIKE_THOUSANDS = re.compile(r"[+-]?\d{1,3}([.,]\d{3})+")
_MILLISECONDS = re.compile(r"\bms(ec)?\b|_ms$|milli")


@dataclass(frozen=True, slots=True, kw_only=True)
class MapProposal:
    """What the columns of a recording seem to be."""

    keys: dict[str, Any]
    left_out: tuple[str, ...]
    """Columns whose names do not tell what they are."""
    lacking: tuple[str, ...]
    """What a map needs and no column seems to be."""
    notes: tuple[str, ...]
    """What a person must look at."""

    @property
    def recording_map(self) -> RecordingMap:
        """The map; only where nothing is lacking."""
        return RecordingMap.model_validate(self.keys)

    def yaml(self) -> str:
        """Return the text of the map's file, with what a person must look at as comments."""
        lines = ["# Proposed from the names of the columns; check every line."]
        lines += [f"# {note}" for note in self.notes]
        lines += [f"# No column seems to be the {key}; write it yourself:" for key in self.lacking]
        lines += [f"# {key}:" for key in self.lacking]
        if self.left_out:
            lines.append(f"# Columns that the map leaves out: {self.named_left_out()}")
        known = yaml.safe_dump(self.keys, sort_keys=False, allow_unicode=True, width=100) if self.keys else ""
        return "\n".join(lines) + "\n" + known

    def named_left_out(self) -> str:
        """Return the names of the columns that are left out; those that are numbers together."""
        numbers = [name for name in self.left_out if name.isdigit()]
        if len(numbers) < FEWEST_NUMBERED:
            return ", ".join(map(repr, self.left_out))
        together = f"{numbers[0]!r} to {numbers[-1]!r} ({len(numbers)} columns that are called by a number; "
        others = [repr(name) for name in self.left_out if name not in numbers]
        return ", ".join([*others, f'{together}"[0-9]*" names all of them)'])


def propose_map(header: Sequence[str], rows: Sequence[Sequence[str]], encoding: str = "utf-8") -> MapProposal:
    """Return what the columns seem to be; `rows` are the texts of the first rows, in their order."""
    keys: dict[str, Any] = {}
    notes: list[str] = []
    unit_row = bool(rows) and not any(_number(text) is not None for text in rows[0]) and len(rows) > 1
    complete = [row[: len(header)] for row in rows[int(unit_row) :] if fits(row, len(header))]
    complete = [row for row, _ in groupby(complete)]
    columns = {name: [row[i] for row in complete] for i, name in enumerate(header) if name}
    described = _described(header, rows[0] if unit_row else ())
    missing = sorted(
        {text for name, texts in columns.items() if _kind(described[name]) for text in _for_missing(texts)}
    )
    keys |= {"missing": missing} if missing else {}
    written = columns
    columns = {name: ["" if text in missing else text for text in texts] for name, texts in columns.items()}
    numbers = [name for name, texts in columns.items() if _numbers(texts)]
    keys |= _time_keys(columns, described, notes)
    taken = {keys.get("time"), keys.get("date")}
    kinds = {name: _kind(described[name]) for name in numbers if name not in taken}
    channels = [name for name, kind in kinds.items() if kind == "displacements"]
    kinds |= {name: None for name in channels if _only_tells(described[name], columns[name])}
    small = [name for name, kind in kinds.items() if kind is None and _is_small(described[name], columns[name])]
    kinds |= dict.fromkeys(small, "displacements")
    if small:
        notes.append(
            f"by their names {', '.join(map(repr, small))} may be displacements or where axes stand: displacements, "
            "because they move and stay within 1 mm of zero"
        )
    speeds = [name for name, kind in kinds.items() if kind == "speed"]
    keys |= _speed_keys(
        speeds, described, [text for name in speeds for text in missing if text in written[name]], notes
    )
    temperatures = [name for name, its in kinds.items() if its == "temperatures"]
    in_unit = {name: _of_temperature(described[name], columns[name]) for name in temperatures}
    broken = _broken({name: columns[name] for name in temperatures if in_unit[name] is None})
    found = {"temperatures": temperatures, "displacements": [name for name in kinds if kinds[name] == "displacements"]}
    keys |= {kind: kept for kind, names in found.items() if (kept := [name for name in names if name not in broken])}
    notes += broken.values()
    others = {name: unit for name, unit in in_unit.items() if unit is not None}
    keys |= {"temperature_units": others} if others else {}
    if coarse := {n: unit for n in keys.get("displacements", ()) if (unit := _coarse(described[n])) is not None}:
        keys["displacement_units"] = coarse
        named = {name: _WITH_COARSE.sub("", name).strip() for name in coarse}
        fitting = {name: channel for name, channel in named.items() if channel and channel not in header}
        if fitting and len(set(named.values())) == len(named):
            keys["displacement_names"] = fitting
    keys |= _decimal_key({name: columns[name] for name in numbers if name in taken or kinds[name] is not None}, notes)
    keys |= {"encoding": encoding} if encoding != "utf-8" else {}
    keys |= {"unit_row": True} if unit_row else {}
    texts = [name for name in columns if complete and name not in numbers and name not in taken]
    unread = {name: _unread(name, written[name], missing) for name in texts if _kind(described[name]) is not None}
    notes += unread.values()
    notes += [
        f"the unit of {name!r} is {unit}: a displacement (displacement_units: {{{name!r}: {unit}}}), or where an axis "
        "stands?"
        for name in numbers
        if name not in taken and kinds[name] is None and (unit := _coarse(described[name])) is not None
    ]
    used = {*taken, keys.get("speed"), *keys.get("temperatures", ()), *keys.get("displacements", ()), *unread, *broken}
    return MapProposal(
        keys=keys,
        left_out=tuple(name for name in header if name and name not in used),
        lacking=tuple(key for key in ("time", "temperatures", "displacements") if key not in keys),
        notes=tuple(notes),
    )


def _speed_keys(
    speeds: list[str], described: Mapping[str, str], missing: Sequence[str], notes: list[str]
) -> dict[str, Any]:
    """Return the keys of the spindle speed; `missing`: texts that stand for no number in columns of speeds."""
    if not speeds:
        return {}
    speeds.sort(key=lambda name: _OF_SPINDLE.search(described[name]) is None)
    notes += [f"{len(speeds)} columns may be the spindle speed: {', '.join(map(repr, speeds))}"] * (len(speeds) > 1)
    notes += [
        f"{text!r} in {speeds[0]!r} counts as missing: where it means that the spindle stands, write 0 there"
        for text in missing
        if text.isalpha()
    ]
    unit = unit_in(described[speeds[0]])
    return {"speed": speeds[0]} | ({"speed_unit": unit} if unit in RPM_PER_UNIT and unit != "1/min" else {})


def _decimal_key(columns: Mapping[str, Sequence[str]], notes: list[str]) -> dict[str, str]:
    """Return the key of the decimal mark; where commas and points stand in numbers, one of them separates thousands."""
    with_mark = {m: {name: text for name, of in columns.items() for text in of if m in text} for m in ",."}
    if not with_mark[","]:
        return {}
    if not with_mark["."]:
        return {"decimal": ","}
    commas = [text for of in columns.values() for text in of if "," in text]
    of_thousands = "," if all(_LIKE_THOUSANDS.fullmatch(text) for text in commas) else "."
    name, text = next(iter(with_mark[of_thousands].items()))
    notes.append(f"{name!r} holds {text!r}: {_WITHOUT_THOUSANDS}")
    return {"decimal": ","} if of_thousands == "." else {}


def _of_temperature(said: str, texts: Sequence[str]) -> str | None:
    """Return the unit of a temperature that is not in degC."""
    if _DEGF.search(said):
        return "degF"
    known = [number for text in texts if (number := _number(text)) is not None]
    return "K" if _KELVIN.search(said) and known and min(known) > _ABSOLUTE_K else None


def _broken(columns: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return why temperatures are left out that cannot be, where others of the same logger can: an open wire, say."""
    degc = {name: median([n for text in texts if (n := _number(text)) is not None]) for name, texts in columns.items()}
    wrong = {name: value for name, value in degc.items() if not LOWEST_DEGC <= value <= HIGHEST_DEGC}
    if len(wrong) == len(degc):
        return {}
    said = "of its first rows, and others do not: is its sensor broken?"
    return {name: f"{name!r} is left out: it reads {value:.6g} in most {said}" for name, value in wrong.items()}


def _described(header: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    """Return what is said of each column, in lower case: its name and its unit."""
    whole = [*units, *[""] * (len(header) - len(units))]
    joined = [f"{n} [{unit.strip(' []()')}]" for n, unit in zip(header, whole, strict=False)] if units else header
    return {name: text.lower().strip() for name, text in zip(header, joined, strict=False)}


def _coarse(said: str) -> str | None:
    """Return the unit of a length that is not in micrometres."""
    return next((unit for unit, form in _COARSE.items() if form.search(said)), None)


def _is_small(said: str, texts: Sequence[str]) -> bool:
    """Return whether a length in mm or in moves and stays so near to zero that it is no axis position."""
    unit = _coarse(said)
    if unit is None or _PLACE.search(said):
        return False
    known = {number for text in texts if (number := _number(text)) is not None}
    return len(known) >= FEWEST_SMALL and max(map(abs, known)) * UM_PER_UNIT[unit] < SMALL_UM


def _only_tells(said: str, texts: Sequence[str]) -> bool:
    """Return whether a column without a unit holds 0 and 1 and nothing else: it tells when something was measured."""
    known = [number for text in texts if (number := _number(text)) is not None]
    return _UM.search(said) is None and len(known) >= FEWEST_SMALL and set(known) == {0.0, 1.0}


def _in_units_of_time(said: str) -> bool:
    """Return whether what is said of a column ends with a unit of time in brackets: `Tempo (s)` is no temperature."""
    found = _IN_BRACKETS.search(said)
    return found is not None and unit_of(found[1]) in TIMES


def _kind(said: str) -> str | None:
    if _in_units_of_time(said):
        return None
    if _SPEED.search(said):
        return None if _NO_TURNS.search(said) else "speed"
    if _UM.search(said):
        return "displacements"
    if _DEGC.search(said) or _DEGF.search(said) or _KELVIN.search(said):
        return "temperatures"
    words = re.sub(r"[_\W]+", " ", said).strip()
    if _coarse(said) is not None:
        return "displacements" if _MOVES.search(words) else None
    if _OTHER_UNIT.search(said):
        return None
    if _TEMPERATURE.search(words):
        return "temperatures"
    return "displacements" if _DISPLACEMENT.search(words) else None


def _time_keys(columns: dict[str, list[str]], described: dict[str, str], notes: list[str]) -> dict[str, Any]:
    """Return the keys that say what the time is."""
    words = {name: re.sub(r"[_\W\d]+", " ", said).strip() for name, said in described.items() if name in columns}
    times = [name for name in words if _in_units_of_time(described[name])]
    times += [name for name, text in words.items() if _TIME.search(text) and not _NUMBERED_T.match(described[name])]
    dates = [name for name, text in words.items() if _DATE.search(text) and name not in times]
    for name in (*times, *dates):
        if form := _time_form(columns[name]):
            keys = {"time": name, **form}
            if form.get("time_format") in _OF_DAY and (date := next(iter(dates), None)) is not None and date != name:
                joined = [f"{day} {text}" for day, text in zip(columns[date], columns[name], strict=True)]
                if whole := _time_form(joined):
                    keys = {"time": name, "date": date, **whole}
            first = f"{columns[keys['date']][0]} {columns[name][0]}" if "date" in keys else columns[name][0]
            if keys.get("time_format") in _OF_DAY:
                return keys
            zone = "in UTC unless the map has a time_zone such as Europe/Zurich"
            if keys.get("time_format", "").startswith(("%d/", "%m/")):
                of_day = keys.get("date", name)
                day = datetime.strptime(first.split()[0], keys["time_format"].split()[0])
                notes.append(
                    f"{of_day!r}: is the day or the month first? The first row is read as {day:%d %B %Y}; where that "
                    f"is wrong, exchange %d and %m. And it is taken to be {zone}"
                )
            elif "time_format" in keys or (
                keys.get("time_unit") == "iso" and datetime.fromisoformat(first).tzinfo is None
            ):
                notes.append(f"{name!r} is taken to be {zone}")
            return keys
    for name in (*times, *dates):
        found = [number for text in columns[name] if (number := _number(text)) is not None]
        if _numbers(columns[name]) and _increases(found) and (name in times or are_days(found)):
            return {"time": name, "time_unit": _counted_in(found, described[name], name, notes)}
    notes += [note for name in dict.fromkeys(times or dates) if (note := _no_time(name, columns[name]))]
    return {}


def _counted_in(found: Sequence[float], said: str, name: str, notes: list[str]) -> str:
    """Return the unit of times that are numbers: by what they are, else by what is said of them."""
    if are_days(found):
        notes.append(f"{name!r} is taken to be in days, as spreadsheets count dates")
        return "d"
    if MILLISECONDS_FROM < found[0] < 1000.0 * MILLISECONDS_FROM:
        began = datetime.fromtimestamp(found[0] / 1000.0, UTC)
        notes.append(f"{name!r} is taken to be milliseconds since 1970: the first row is of {began:%d %B %Y}")
        return "ms"
    step = median(second - first for first, second in pairwise(found)) if len(found) > 1 else 0.0
    return _unit(said, name, step, notes)


def _no_time(name: str, texts: Sequence[str]) -> str:
    """Return why a column that is called like a time is none, '' where that is plain."""
    if _time_form([*dict.fromkeys(texts)]) is not None:
        return (
            f"{name!r} says the same time in rows one after the other: take one of two such rows out, or export it "
            "with seconds where it has none"
        )
    if with_marks := next(filter(has_thousands, texts), ""):
        return f"{name!r} holds {with_marks!r}: {_WITHOUT_THOUSANDS}"
    if _numbers(texts):
        return (
            f"{name!r} holds numbers that do not grow from row to row: where the newest row comes first, sort the rows "
            "by time; where the logger was restarted, split the file there"
        )
    if not texts:
        return ""
    return (
        f"{name!r} holds {texts[0]!r}, a time of a form that is not known: say it as time_format, such as "
        "'%d.%m.%Y %H:%M:%S'"
    )


def _unit(said: str, name: str, step: float, notes: list[str]) -> str:
    if _MILLISECONDS.search(said):
        return "ms"
    if re.search(r"\bmin(ut(e|en|es|os))?s?\b|_min\b|[\[(]分", said):
        return "min"
    if re.search(r"\bh(ours?|rs?)?\b|_h\b|stunden|\bstd\b", said):
        return "h"
    if re.search(r"\bd(ays?)?\b|_d\b|\btage?\b", said):
        return "d"
    if not re.search(r"\bs(e[ck]|econds?)?\b|_s\b|sekunden?", said):
        notes.append(
            f"{name!r} is taken to be in seconds{f', a row every {step:g} s' if step else ''}; its name does not say "
            "so: where that is wrong, say time_unit: ms, min, h or d"
        )
    return "s"


def _time_form(texts: Sequence[str]) -> dict[str, str] | None:
    """Return the key that says how times are written; None where they are no dates or times of day."""
    if not texts or _numbers(texts):
        return None
    if _reads(texts, datetime.fromisoformat):
        return {"time_unit": "iso"}
    for form in (*_FORMATS, *_OF_DAY):
        if _reads(texts, lambda text, form=form: datetime.strptime(text, form)):  # type: ignore[misc]
            return {"time_format": form}
    return None


def _reads(texts: Sequence[str], read: Callable[[str], datetime]) -> bool:
    try:
        moments = [read(text) for text in texts]
        return all(first != second for first, second in pairwise(moments))
    except (ValueError, TypeError):
        return False


def _increases(numbers: Sequence[float]) -> bool:
    return all(first < second for first, second in pairwise(numbers))


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def _for_missing(texts: Sequence[str]) -> set[str]:
    """Return what stands for a missing value in a column of numbers, such as OL."""
    known = [text for text in texts if _number(text) is not None]
    words = {text for text in texts if text and _number(text) is None}
    wordy = 2 * len(known) < len([text for text in texts if text])
    if wordy:
        return set()
    told = {text for text in words if _NO_NUMBER.match(text) or not any(mark.isdigit() for mark in text)}
    return _far_nines(known) | told | {text for text in known if abs(_number(text) or 0.0) > LARGEST}


def _far_nines(texts: Sequence[str]) -> set[str]:
    """Return the numbers, such as -9999, that loggers write for no value, where they lie far from all others."""
    nines = {text for text in texts if _NINES.fullmatch(text)}
    others = [number for text in texts if text not in nines and (number := _number(text)) is not None]
    if not nines or len(others) <= len(texts) / 2:
        return set()
    low, high = min(others), max(others)
    far = FAR_OFF * max(high - low, abs(low), abs(high))
    return {text for text in nines if not low - far <= (_number(text) or 0.0) <= high + far}


def _unread(name: str, texts: Sequence[str], missing: Sequence[str]) -> str:
    """Return why a column is left out whose name says what it is, and whose fields are no numbers."""
    wrong = [(n, each) for n, each in enumerate(texts, 1) if each and each not in missing and _number(each) is None]
    row, text = wrong[0] if wrong else (1, texts[0])
    held = f"{text!r}" if text else "an empty field"
    if has_thousands(text):
        return f"{name!r} is left out: row {row} holds {held}; {_WITHOUT_THOUSANDS}"
    if not any(_number(each) is not None for each in texts):
        rows = f"none of its first {len(texts)} rows holds a number, row {row} {held}"
        return f"{name!r} is left out: {rows}; is its sensor broken?"
    return (
        f"{name!r} is left out: row {row} holds {held}, which is no number; leave the field empty there and add the "
        "column to the map"
    )


def _numbers(texts: Sequence[str]) -> bool:
    """Return whether a column holds numbers: some, and beside them only fields that stand for none."""
    read = [_number(text) for text in texts if text not in {"", "NA", "nan", "NaN"}]
    return bool(read) and None not in read
