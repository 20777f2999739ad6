"""The terminal view of a running daemon, and of the simulated machine beside it.

It fits the terminal: where lines are few, what matters least is left out, and a line says so; nothing is cut off.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.rule import Rule
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

STATE_STYLES = {
    "OFF": "bold white on grey37",
    "ARMED": "bold black on yellow",
    "ACTIVE": "bold white on green4",
    "HOLD": "bold black on orange1",
    "RETREAT": "bold black on cyan",
    "FAULT": "bold white on red3",
}
SPARKS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 36
LABEL_WIDTH = 18
"""What a line is about stands in a column of this width [character]."""
NARROW = 60
"""On a narrower terminal these words stand on a line of their own [character]."""
LEAST_BAR = 5
"""Of a gauge, without the numbers at its ends [character]."""
NUMBERS_WIDTH = 23
"""Of the two numbers of an axis, with the space around them [character]."""
LEFT_OUT = "a taller terminal shows more"
SAME_UM = 0.05
"""A smaller difference is not seen in tenths [um]."""


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """Return a number for a table, a dash when it is not known."""
    return "–" if value is None else f"{value:+.{digits}f}{unit}" if unit == "" else f"{value:.{digits}f}{unit}"


def milliseconds(value: float | None) -> str:
    """Return seconds as milliseconds for a table."""
    return "–" if value is None else f"{value * 1e3:.2f} ms"


def sparkline(values: Sequence[float], *, top: float, width: int = SPARK_WIDTH) -> str:
    """Return magnitudes as a line of block characters from 0 to `top`, thinned out to `width`."""
    every = max(1, -(-len(values) // max(width, 1)))
    shown = values[::-every][::-1]
    steps = len(SPARKS) - 1
    return "".join(SPARKS[round(min(abs(value) / (top or 1.0), 1.0) * steps)] for value in shown)


def status_view(
    picture: Mapping[str, Any], beside: Sequence[RenderableType] = (), footer: str = "", *, live: bool = False
) -> RenderableType:
    """Return the view of one status picture, `live` one that fits the terminal; `beside` comes under the header."""
    return _Fitted(
        live,
        [
            (0, Rule(f"Toolpoint · {picture['machine']}", align="left", style="dim")),
            (0, _header(picture)),
            (3, _permitted(picture["output"])),
            *((1, renderable) for renderable in beside),
            (0, _Axes(picture["axes"])),
            (2, _labelled("temperatures [°C]", _temperatures(picture["temperatures"]))),
            (2, _labelled("CNC", _cnc(picture))),
            (2, _labelled("delay", _latency(picture["latency_s"]))),
            (1, _labelled("links", _links(picture))),
            (0, Text(footer, style="dim") if footer else None),
        ],
    )


class _Flow:
    """Parts one after the other; a line ends between two of them."""

    def __init__(self, parts: Sequence[Text], gap: str) -> None:
        self._parts, self._gap = parts, gap

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        line = Text()
        for part in self._parts:
            if line and line.cell_len + len(self._gap) + part.cell_len > options.max_width:
                yield line
                line = Text()
            line = Text.assemble(line, self._gap if line else "", part)
        yield line


class _Fitted:
    """Pieces one under the other, with space between where there is room, and without the least where there is none."""

    def __init__(self, live: bool, pieces: Sequence[tuple[int, RenderableType | None]]) -> None:
        """`pieces`: how soon it is left out (0: never), and what; None is left out always."""
        self._live, self._pieces = live, [(rank, piece) for rank, piece in pieces if piece is not None]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        free = options.update(height=None)
        drawn = [(rank, console.render_lines(piece, free, pad=False)) for rank, piece in self._pieces]
        height = options.size.height if self._live else None  # `Live` hands no height on
        shown = drawn
        worst = max((rank for rank, _ in drawn), default=0)
        while height is not None and sum(len(lines) for _, lines in shown) > height and worst > 0:
            shown = [(rank, lines) for rank, lines in drawn if rank < worst]
            worst -= 1
        count = sum(len(lines) for _, lines in shown)
        if shown is not drawn and height is not None and count < height:
            shown = [*shown, (0, console.render_lines(Text(LEFT_OUT, style="dim"), free, pad=False))]
        airy = height is None or count + len(shown) - 1 <= height
        for place, (_, lines) in enumerate(shown):
            if airy and place > 1:
                yield Segment.line()
            for line in lines:
                yield from line
                yield Segment.line()


def _labelled(label: str, body: RenderableType | None) -> RenderableType | None:
    return None if body is None else _Labelled(label, body)


class _Labelled:
    """A body beside the words that say what it is about, or below them where the terminal is narrow."""

    def __init__(self, label: str, body: RenderableType) -> None:
        self._label, self._body = Text(label, style="bold"), body

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if options.max_width < NARROW:
            yield Group(self._label, self._body)
            return
        table = Table.grid()
        table.add_column(width=LABEL_WIDTH)
        table.add_column(width=options.max_width - LABEL_WIDTH, overflow="fold")
        table.add_row(self._label, self._body)
        yield table


def _header(picture: Mapping[str, Any]) -> Text:
    output = picture["output"]
    line = Text.assemble((f" {output['state']} ", STATE_STYLES.get(output["state"], "bold")), "  ", output["reason"])
    if picture["cnc"] is not None:
        line.append("; the machine is ", style="dim")
        line.append("at a safe point" if output["phase"] == "safe point" else output["phase"])
    reference = picture["reference"]
    if reference is None:
        line.append(f"\nno reference: {picture.get('reference_ended') or 'waiting for work positioning'}", style="dim")
    else:
        line.append(f"\nreference {reference['source']}, {reference['age_s'] / 60:.1f} min ago", style="dim")
    if tools := picture.get("tools_set"):
        line.append(f"; tools set: {', '.join(f'T{number}' for number in tools)}", style="dim")
    if output["weight"] is not None and output["weight"] < 1.0:
        line.append(f"\nthe estimate counts {output['weight']:.0%}: sensors are missing", style="yellow")
    if output["alarm"]:
        said_above = f"FAULT: {output['reason']}; "
        line.append(f"\n{output['alarm'].removeprefix(said_above)}", style="bold red")
    elif output["notices"]:
        line.append(f"\n{output['notices'][-1]}", style="dim")
    if problem := picture["model"].get("problem"):
        beginning = "model refused" if picture["model"].get("model_id") else "no model in force"
        line.append(f"\n{beginning}: {problem}", style="red")
    if waits := picture["model"].get("waits"):
        line.append(f"\nmodel {waits}", style="yellow")
    if speed := picture.get("spindle_speed"):
        line.append(f"\nspindle speed {speed_in_words(speed)}", style="bold red" if speed["alarm"] else "dim")
    return line


def _permitted(output: Mapping[str, Any]) -> Text | None:
    """Return what the configuration permits that a real machine should not have."""
    words = []
    if output["insecure_writes"]:
        words.append("insecure connection; not for a real machine: allow_insecure_writes")
    if output["writable_model_directory"]:
        words.append("any model is loaded; not for a real machine: allow_writable_model_directory")
    return Text("\n".join(words), style="yellow") if words else None


def speed_in_words(speed: Mapping[str, Any]) -> str:
    """Return the state of the spindle speed's tuning in one line."""
    words = f"{speed['state']}: {speed['alarm'] or speed['reason']}"
    if speed["commanded_rpm"] is None:
        return words
    return f"S{speed['commanded_rpm']:.0f} for S{speed['programmed_rpm']:.0f}, {words}"


class _Axes:
    """Each axis: estimated, requested, written, applied, and a gauge of the bound where there is room."""

    HEADINGS = ("compensation [µm]", "on", "estimated", "requested", "written", "applied", "within bound")
    NUMBERS_END = 60
    """The gauge stands behind this column."""

    def __init__(self, axes: Mapping[str, Mapping[str, Any]]) -> None:
        self._axes = axes

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = min(options.max_width - self.NUMBERS_END, 45)
        narrow = width < max((_least_gauge(axis["bound_um"]) for axis in self._axes.values()), default=0)
        table = Table(box=None, padding=(0, 0, 0, 1), pad_edge=False, header_style="bold")
        for place, heading in enumerate(self.HEADINGS[:-1]):
            words = ("axis", "on", "estim.", "request", "written", "applied")[place] if narrow else heading
            table.add_column(words, justify="right" if place > 1 else "left", no_wrap=True)
        if not narrow:
            table.add_column(self.HEADINGS[-1] if width >= len(self.HEADINGS[-1]) else "", no_wrap=True)
        for called, axis in self._axes.items():
            name = f"{called} um/m" if axis.get("unit") else called
            if axis["estimate_from"] is None:
                words = "no model for this axis" if width >= 23 else "no model"
                table.add_row(name, "–", *["–"] * 4, *([] if narrow else [Text(words, style="dim")]))
                continue
            values = [axis[key] for key in ("thermal_error_um", "requested_um", "written_um", "applied_um")]
            gauge = [] if narrow else [_gauge(axis["applied_um"], axis["bound_um"], width)]
            table.add_row(name, "yes" if axis["wanted"] else "no", *(number(value) for value in values), *gauge)
        yield table
        if words := _since_reference(self._axes):
            yield Text(words, style="dim")
        if pivots := [f"{name} {axis['pivot_mm']:g} mm" for name, axis in self._axes.items() if "pivot_mm" in axis]:
            yield Text(f"with a slope, numbers hold at the pivot: {', '.join(pivots)}", style="dim")


def _since_reference(axes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return why the request is not minus the estimate: the offset that was applied at the reference stays in it."""
    offsets = {name: axis.get("baseline_um") for name, axis in axes.items()}
    known = [f"{name} {value:+.1f}" for name, value in offsets.items() if value is not None and abs(value) > SAME_UM]
    if not known:
        return ""
    return f"requested = what was applied at the reference ({', '.join(known)}) - estimated"


def _least_gauge(bound: float) -> int:
    return len(f"{-bound:+.0f} {bound:+.0f} ") + LEAST_BAR


def _gauge(value: float | None, bound: float, width: int) -> Text:
    """Return a bar from -bound to +bound with the value marked."""
    low, high = f"{-bound:+.0f} ", f" {bound:+.0f}"
    inner = (width - len(low) - len(high) - 1) | 1
    text = Text(low)
    place = None if value is None else round((min(max(value / bound, -1.0), 1.0) + 1.0) / 2.0 * (inner - 1))
    for index in range(inner):
        mark, style = ("●", "bold green") if index == place else ("│" if index == inner // 2 else "─", "dim")
        text.append(mark, style=style)
    return text.append(high)


def _temperatures(temperatures: Mapping[str, Any] | None) -> RenderableType:
    if temperatures is None:
        return Text("none yet")
    parts = [
        Text.assemble((f"{label} ", "dim"), number(value, 2, " ").rstrip())
        for label, value in temperatures["labels_degc"].items()
    ]
    parts.append(Text(f"{temperatures['usable']} of {temperatures['total']} usable"))
    parts += [
        Text(f"sensor {sensor}: {why}", style="yellow") for sensor, why in list(temperatures["not_good"].items())[:3]
    ]
    parts += [
        Text(f"line {line}: {faults[0]}", style="yellow")
        for line, faults in temperatures.get("line_faults", {}).items()
    ]
    return _Flow(parts, "  ")


def _cnc(picture: Mapping[str, Any]) -> RenderableType:
    cnc, writes = picture["cnc"], picture["writes"]
    if cnc is None:
        return Text("not connected", style="bold red")
    parts = (
        f"O{cnc['program']} N{cnc['sequence_number']}",
        f"{cnc['mode']}, {cnc['run']}{', ALARM' if cnc['alarm'] else ''}",
        f"{number(cnc['spindle_speed_rpm'], 0, ' 1/min')}, motor {number(cnc['motor_temperature_degc'], 0, ' °C')}",
        f"T{cnc['tool_number']}, G{cnc['work_offset']}",
        f"{writes['verified']} of {writes['sent']} writes read back and equal",
    )
    return _Flow([Text(part) for part in parts], " · ")


def _latency(latency: Mapping[str, Any]) -> RenderableType:
    published = latency["published"]
    mean = {part: latency[part]["mean"] for part in ("measurement", "feedback", "total")}
    here = (number(mean["measurement"], 2, " s"), milliseconds(mean["feedback"]), number(mean["total"], 2, " s"))
    theirs = (f"> {published['measurement']:g} s", f"{published['feedback']} s", f"{published['total']} s")
    rows = [
        [Text.assemble((f"{part} ", "dim"), value) for part, value in zip(mean, row, strict=True)]
        for row in (here, theirs)
    ]
    return Group(_Flow(rows[0], "  "), _Flow([*rows[1], Text("published, by another rig", style="dim")], "  "))


def _links(picture: Mapping[str, Any]) -> RenderableType:
    parts = []
    for link in picture["links"]:
        part = Text.assemble(("● ", "green") if link["up"] else ("○ ", "bold red"), link["name"])
        if not link["up"] and link["problem"]:
            part.append(f" ({link['problem']})", style="red")
        parts.append(part)
    if (rows := picture.get("displacement_rows")) and rows["problems"]:
        words = f"{rows['problems']} problems in displacement files, the latest: {rows['last_problem']}"
        parts.append(Text(words, style="yellow"))
    for job in picture.get("jobs", ()):
        if job["problem"]:
            parts.append(Text(f"{job['name']}: {job['problem']}", style="red"))
    cycles = picture["cycles"]
    parts.append(Text(f"{cycles['received']} line cycles, {cycles['incomplete']} incomplete", style="dim"))
    return _Flow(parts, "  ")


def truth_panel(report: Mapping[str, Any], trail: Mapping[str, Sequence[tuple[float, float]]]) -> RenderableType:
    """Return the simulated machine's own account: the tool point with and without compensation."""
    return _Truth(report, trail)


class _Truth:
    """The simulated machine's own account: the tool point with and without compensation."""

    def __init__(self, report: Mapping[str, Any], trail: Mapping[str, Sequence[tuple[float, float]]]) -> None:
        self._report, self._trail = report, trail

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        narrow = options.max_width < NARROW
        spark = 0 if narrow else min((options.max_width - LABEL_WIDTH - NUMBERS_WIDTH - 2) // 2, 45)
        table = Table(box=None, padding=(0, 0, 0, 1), pad_edge=False, header_style="bold")
        minutes = f"{self._report['time_s'] / 60:.1f} min"
        table.add_column(minutes if narrow else f"true error, {minutes}"[: LABEL_WIDTH + 2], no_wrap=True)
        table.add_column("without", justify="right", no_wrap=True)
        table.add_column("with", justify="right", no_wrap=True, min_width=8)
        if spark:
            table.add_column("without, over time", no_wrap=True, width=spark)
            table.add_column("with, same scale", no_wrap=True, width=spark)
        top = max((abs(pair[0]) for series in self._trail.values() for pair in series), default=1.0)
        for axis, truth in self._report["truth"].items():
            series = list(self._trail.get(axis, ()))
            lines = [
                Text(sparkline([pair[side] for pair in series], top=top, width=spark), style=("red", "green")[side])
                for side in (0, 1)
            ]
            numbers = number(truth["uncompensated_um"]), Text(number(truth["compensated_um"]), style="bold green")
            table.add_row(axis, *numbers, *(lines if spark else ()))
        yield table
