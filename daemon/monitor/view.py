"""The terminal view of a running daemon, and of the simulated machine beside it."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
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
LEAST_PANEL_WIDTH = 42
"""A panel of the middle row is never narrower [character]."""


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """Return a number for a table, a dash when it is not known."""
    return "–" if value is None else f"{value:+.{digits}f}{unit}" if unit == "" else f"{value:.{digits}f}{unit}"


def milliseconds(value: float | None) -> str:
    """Return seconds as milliseconds for a table."""
    return "–" if value is None else f"{value * 1e3:.2f} ms"


def sparkline(values: Sequence[float], *, top: float, width: int = SPARK_WIDTH) -> str:
    """Return magnitudes as a line of block characters from 0 to `top`, thinned out to `width`."""
    every = max(1, -(-len(values) // width))
    shown = values[::-every][::-1]
    steps = len(SPARKS) - 1
    return "".join(SPARKS[round(min(abs(value) / (top or 1.0), 1.0) * steps)] for value in shown)


def status_view(picture: Mapping[str, Any], beside: Sequence[RenderableType] = (), footer: str = "") -> Group:
    """Return the whole view of one status picture; `beside` comes under the header."""
    return Group(
        _header(picture),
        *beside,
        _axes(picture["axes"]),
        _SideBySide(_temperatures(picture), _cnc(picture), _latency(picture)),
        _links(picture),
        Text(footer, style="dim"),
    )


class _SideBySide:
    """Panels in one row, or one under the other where the terminal is too narrow for their words."""

    def __init__(self, *panels: RenderableType) -> None:
        self._panels = panels

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if options.max_width < LEAST_PANEL_WIDTH * len(self._panels):
            yield from self._panels
            return
        table = Table.grid(expand=True)
        for _ in self._panels:
            table.add_column(ratio=1)
        table.add_row(*self._panels)
        yield table


def _header(picture: Mapping[str, Any]) -> Panel:
    output = picture["output"]
    line = Text.assemble(
        (f" {output['state']} ", STATE_STYLES.get(output["state"], "bold")),
        "  ",
        output["reason"],
        ("   machine is ", "dim"),
        output["phase"],
    )
    reference = picture["reference"]
    if reference is None:
        line.append(f"\nno reference: {picture.get('reference_ended') or 'waiting for work positioning'}", style="dim")
    else:
        line.append(f"\nreference {reference['source']}, {reference['age_s'] / 60:.1f} min ago", style="dim")
    if tools := picture.get("tools_set"):
        line.append(f"\ntools set: {', '.join(f'T{number}' for number in tools)}", style="dim")
    if output["weight"] is not None and output["weight"] < 1.0:
        line.append(f"\nthe estimate counts {output['weight']:.0%}: sensors are missing", style="yellow")
    if output["alarm"]:
        line.append(f"\n{output['alarm']}", style="bold red")
    elif output["notices"]:
        line.append(f"\n{output['notices'][-1]}", style="dim")
    if problem := picture["model"].get("problem"):
        line.append(f"\nmodel refused: {problem}", style="red")
    if speed := picture.get("spindle_speed"):
        line.append(f"\nspindle speed {speed_in_words(speed)}", style="bold red" if speed["alarm"] else "dim")
    if output["insecure_writes"]:
        line.append("\nwrites go over an insecure connection (allow_insecure_writes)", style="yellow")
    if output["writable_model_directory"]:
        line.append("\nany model is loaded, released or not (allow_writable_model_directory)", style="yellow")
    return Panel(line, title=f"Toolpoint · {picture['machine']}", title_align="left")


def speed_in_words(speed: Mapping[str, Any]) -> str:
    """Return the state of the spindle speed's tuning in one line."""
    words = f"{speed['state']}: {speed['alarm'] or speed['reason']}"
    if speed["commanded_rpm"] is None:
        return words
    return f"S{speed['commanded_rpm']:.0f} for S{speed['programmed_rpm']:.0f}, {words}"


def _axes(axes: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table(title="Compensation [µm]", title_justify="left", expand=True)
    for column in ("axis", "on", "estimated error", "requested", "written", "applied by the CNC", "within bound"):
        table.add_column(column, justify="left" if column in ("axis", "within bound") else "right")
    for name, axis in axes.items():
        if axis["estimate_from"] is None:
            table.add_row(name, "–", *["–"] * 4, Text("no model for this axis: disabled", style="dim"))
            continue
        table.add_row(
            name,
            "yes" if axis["wanted"] else "no",
            number(axis["thermal_error_um"]),
            number(axis["requested_um"]),
            number(axis["written_um"]),
            number(axis["applied_um"]),
            _gauge(axis["applied_um"], axis["bound_um"]),
        )
    return table


def _gauge(value: float | None, bound: float) -> Text:
    """Return a bar from -bound to +bound with the value marked."""
    width = 25
    text = Text(f"{-bound:+.0f} ")
    place = None if value is None else round((min(max(value / bound, -1.0), 1.0) + 1.0) / 2.0 * (width - 1))
    for index in range(width):
        mark, style = ("●", "bold green") if index == place else ("│" if index == width // 2 else "─", "dim")
        text.append(mark, style=style)
    return text.append(f" {bound:+.0f}")


def _temperatures(picture: Mapping[str, Any]) -> Panel:
    temperatures = picture["temperatures"]
    if temperatures is None:
        return Panel("no temperatures yet", title="Temperatures [°C]")
    table = Table.grid(padding=(0, 2))
    labels = list(temperatures["labels_degc"].items())
    for left, right in zip(labels[::2], [*labels[1::2], ("", None)], strict=False):
        table.add_row(left[0], number(left[1], 2, " "), right[0], number(right[1], 2, " ") if right[0] else "")
    table.add_row("usable", f"{temperatures['usable']} of {temperatures['total']}")
    for sensor, why in list(temperatures["not_good"].items())[:3]:
        table.add_row(f"sensor {sensor}", Text(why, style="yellow"))
    return Panel(table, title="Temperatures [°C]")


def _cnc(picture: Mapping[str, Any]) -> Panel:
    cnc = picture["cnc"]
    if cnc is None:
        return Panel(Text("not connected", style="bold red"), title="CNC")
    table = Table.grid(padding=(0, 2))
    table.add_row("program", f"O{cnc['program']} N{cnc['sequence_number']}")
    table.add_row("state", f"{cnc['mode']}, {cnc['run']}{', ALARM' if cnc['alarm'] else ''}")
    table.add_row("spindle", f"{cnc['spindle_speed_rpm']:.0f} 1/min, motor {cnc['motor_temperature_degc']:.0f} °C")
    table.add_row("tool, offset", f"T{cnc['tool_number']}, G{cnc['work_offset']}")
    writes = picture["writes"]
    table.add_row("writes", f"{writes['verified']} of {writes['sent']} read back and equal")
    return Panel(table, title="CNC")


def _latency(picture: Mapping[str, Any]) -> Panel:
    latency = picture["latency_s"]
    table = Table.grid(padding=(0, 1))
    table.add_row("", "mean", "p99", "published*")
    feedback, total, published = latency["feedback"], latency["total"], latency["published"]
    measurement = latency["measurement"]
    means = number(measurement["mean"], 2, " s"), number(measurement["p99"], 2, " s")
    table.add_row("measurement", *means, f"> {published['measurement']:g} s")
    table.add_row(
        "feedback", milliseconds(feedback["mean"]), milliseconds(feedback["p99"]), f"{published['feedback']} s"
    )
    table.add_row("total", number(total["mean"], 2, " s"), number(total["p99"], 2, " s"), f"{published['total']} s")
    note = Text("* another rig, with database polling", style="dim")
    return Panel(Group(table, note), title="Delay")


def _links(picture: Mapping[str, Any]) -> Text:
    text = Text()
    for link in picture["links"]:
        text.append("● " if link["up"] else "○ ", style="green" if link["up"] else "bold red")
        text.append(link["name"] + "  ")
        if not link["up"] and link["problem"]:
            text.append(f"({link['problem']})  ", style="red")
    for line, faults in ((picture["temperatures"] or {}).get("line_faults", {})).items():
        text.append(f"\nline {line}: {faults[0]}", style="yellow")
    if (rows := picture.get("displacement_rows")) and rows["problems"]:
        text.append(
            f"\n{rows['problems']} problems in displacement files, the latest: {rows['last_problem']}", "yellow"
        )
    cycles = picture["cycles"]
    text.append(f"\n{cycles['received']} line cycles, {cycles['incomplete']} incomplete", style="dim")
    return text


def truth_panel(report: Mapping[str, Any], trail: Mapping[str, Sequence[tuple[float, float]]]) -> Panel:
    """Return the simulated machine's own account: the tool point with and without compensation."""
    table = Table(expand=True, box=None)
    for column in ("axis", "without [µm]", "with [µm]", "without compensation, over time", "with, same scale"):
        table.add_column(column, no_wrap=True)
    top = max((abs(pair[0]) for series in trail.values() for pair in series), default=1.0)
    for axis, truth in report["truth"].items():
        series = list(trail.get(axis, ()))
        table.add_row(
            axis,
            number(truth["uncompensated_um"]),
            Text(number(truth["compensated_um"]), style="bold green"),
            Text(sparkline([pair[0] for pair in series], top=top), style="red"),
            Text(sparkline([pair[1] for pair in series], top=top), style="green"),
        )
    minutes = report["time_s"] / 60
    return Panel(
        table, title=f"Simulated machine · {minutes:.1f} min · tool point since work positioning", title_align="left"
    )
