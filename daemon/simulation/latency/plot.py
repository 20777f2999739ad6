"""Pictures of the delay experiment: both distributions, and the series around the moves (as Figs 2-8 and 2-9)."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from config.html_page import Section, html_page
from daemon.simulation.latency.experiment import Setting
from daemon.simulation.latency.result import Account, Move

MEASURED, TOTAL, PUBLISHED, SENSOR = "#3a6ea5", "#d9822b", "#888888", "#2f8f5b"
CLOSE_UP_S = 60.0
"""The lower picture shows this much around the first move [s]."""


def draw(path: Path, setting: Setting, account: Account, moves: Sequence[Move], numbers: dict[str, Any]) -> None:
    """Write the picture as PNG, SVG, or a page of HTML that holds it with its numbers."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False)[:, 0]
    _distributions(upper.subplots(1, 2, width_ratios=(2.0, 1.0)), moves, numbers)
    _series(lower.subplots(1, 2, width_ratios=(2.0, 1.0)), setting, account, numbers)
    lower.supxlabel(f"* {numbers['published']['note']}.", fontsize="small", color=PUBLISHED)
    if path.suffix.lower() != ".html":
        figure.savefig(path, dpi=120)
        return
    picture = io.StringIO()
    figure.savefig(picture, format="svg")
    path.write_text(_page(picture.getvalue(), numbers), encoding="utf-8")


def _distributions(axes: Sequence[Axes], moves: Sequence[Move], numbers: dict[str, Any]) -> None:
    """Draw the delays of every move, and how they are distributed, beside the published means."""
    bars, box = axes
    measurement, total = [move.measurement_s for move in moves], [move.total_s for move in moves]
    at = [move.number for move in moves]
    published = numbers["published"]
    for offset, values, colour, name in (
        (-0.2, measurement, MEASURED, "measurement"),
        (0.2, total, TOTAL, "measurement and feedback"),
    ):
        mean = sum(values) / len(values) if values else float("nan")
        bars.bar([x + offset for x in at], values, width=0.4, color=colour, label=f"{name}: mean {mean:.2f} s")
    bars.axhline(
        published["total_s"], color=PUBLISHED, linestyle="--", label=f"published total: {published['total_s']:g} s*"
    )
    bars.axhline(
        published["measurement_s"],
        color=PUBLISHED,
        linestyle=":",
        label=f"published measurement: more than {published['measurement_s']:g} s*",
    )
    bars.set_xticks(at)
    bars.set_ylim(0.0, 1.45 * max([published["total_s"], *total]))
    bars.set(xlabel="move", ylabel="delay [s]", title=_title(numbers))
    bars.legend(fontsize="small", loc="upper left")
    if moves:
        box.boxplot([measurement, total], widths=0.6)
    box.set_xticks([1, 2], ["measurement", "and feedback"])
    box.set(ylabel="delay [s]", title="distribution")
    product_ms = numbers["parts_s"]["product"]
    if product_ms["mean"] is not None:
        box.set_xlabel(
            f"the product's share: mean {1e3 * product_ms['mean']:.1f}, max {1e3 * product_ms['max']:.1f} ms"
        )


def _series(axes: Sequence[Axes], setting: Setting, account: Account, numbers: dict[str, Any]) -> None:
    """Draw readings and macro over time, whole and around the first move."""
    whole, close_up = axes
    passes = [event for event in account.passes if event["line"] == setting.line]
    macros = [event for event in account.macros if event["value"] is not None]
    temperature = numbers["mode"] == "temperature"
    for axis in (whole, close_up):
        axis.plot(
            [event["end_s"] for event in passes],
            [event["degc"] for event in passes],
            ".-",
            color=SENSOR,
            drawstyle="steps-post",
            label="reading, last byte [degC]",
        )
        other = axis if temperature else axis.twinx()
        other.plot(
            [_set_at_s(account, event) for event in macros],
            [event["value"] for event in macros],
            color=TOTAL,
            drawstyle="steps-post",
            label=f"macro #{setting.script.macro} [{'degC' if temperature else 'mm'}]",
        )
        for move_s in setting.script.moves_s:
            axis.axvline(move_s, color=PUBLISHED, linewidth=0.8)
        axis.set_xlabel("simulated time [s]; grey: the sensor is moved")
        axis.legend(fontsize="small", loc="upper left")
        if other is not axis:
            other.legend(fontsize="small", loc="lower left")
    first_s = setting.script.moves_s[0]
    close_up.set_xlim(first_s - CLOSE_UP_S / 4, first_s + CLOSE_UP_S)
    close_up.set_title("around the first move")


def _set_at_s(account: Account, event: dict[str, Any]) -> float:
    """Return when a macro was set on the machine's time, the product's share not scaled [s]."""
    before = [passed for passed in account.passes if passed["real_s"] <= event["real_s"]]
    if not before:
        return float(event["time_s"])
    return float(before[-1]["end_s"] + event["real_s"] - before[-1]["real_s"])


def _title(numbers: dict[str, Any]) -> str:
    cleansing = "on" if numbers["cleansing"] else "off"
    return f"mode {numbers['mode']}, cleansing {cleansing}, {numbers['switches']} moves, speed {numbers['speed']:g}"


def _page(svg: str, numbers: dict[str, Any]) -> str:
    shown = {name: numbers[f"{name}_s"] for name in ("measurement", "feedback", "total")}
    parts = {f"\u2003{name.replace('_', ' ')}": part for name, part in numbers["parts_s"].items()}
    rows = []
    for name, part in (shown | parts | {"\u2003held back": numbers["held_back_s"]}).items():
        figures = ("-" if part[key] is None else f"{part[key]:.4f}" for key in ("mean", "p50", "p99", "max"))
        rows.append((name, *figures, str(numbers["published"].get(f"{name}_s", ""))))
    note = (
        f"* {numbers['published']['note']}. The product's share is wall time; all other parts are the machine's time."
    )
    sections = (
        Section(text=_title(numbers)),
        Section(picture=svg[svg.index("<svg") :]),
        Section(head=("[s]", "mean", "p50", "p99", "max", "published*"), rows=tuple(rows), kind="numbers"),
        Section(text=note),
    )
    return html_page("Delay from sensor to macro", sections)
