"""Draws docs/images/demo.svg anew: runs the demonstration and keeps the last picture of its terminal view.

From the repository: `.venv/bin/python -P docs/images/render_demo.py`. It takes about half a minute.
"""

import hashlib
import io
import re
import time
from pathlib import Path

import click
from rich.console import Console

from daemon.cli.simulate.demo import demo_machine
from daemon.monitor import view
from daemon.monitor.view import status_view, truth_panel
from daemon.simulation.demonstration import Trail, switch_on, watch
from daemon.simulation.processes import folder_for, start_simulation, write_simulation_configuration

OUTPUT = Path(__file__).with_name("demo.svg")
VIEW = Path(view.__file__)
WIDTH = 100


def made_by() -> str:
    """Return the last line of the picture: what of the code it shows, so that a test sees when that has changed."""
    return f"<!-- view.py {hashlib.sha256(VIEW.read_bytes()).hexdigest()[:16]} -->"


@click.command()
@click.option("--minutes", type=float, default=40.0, show_default=True, help="Simulated minutes until the picture.")
@click.option("--speed", type=float, default=120.0, show_default=True, help="Simulated seconds per second.")
def draw(minutes: float, speed: float) -> None:
    """Run the demonstration and write the picture beside this script."""
    trail = Trail()
    with folder_for(None) as folder:
        path, _ = write_simulation_configuration(demo_machine(), folder, speed=speed)
        with start_simulation([], path, speed=speed, epoch_utc_s=time.time(), directory=folder) as running:
            switch_on(running)
            watch(running, minutes * 60.0, lambda _: None, 5.0)
            report = trail.take(running.reports)
            status = running.client.ask("status")
    if report is None:
        raise click.ClickException("the simulated machine reported nothing")
    console = Console(record=True, width=WIDTH, file=io.StringIO(), force_terminal=True, color_system="truecolor")
    console.print(status_view(status, [truth_panel(report, trail.axes)]))
    svg = console.export_svg(title="toolpoint demo")
    # The fonts of the reader's own computer serve: the picture fetches nothing from anywhere.
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)
    lines = [*(line.rstrip() for line in svg.splitlines()), made_by()]
    OUTPUT.write_text("\n".join(lines) + "\n", encoding="utf-8")
    click.echo(f"{OUTPUT}: {OUTPUT.stat().st_size} bytes")


if __name__ == "__main__":
    draw()
