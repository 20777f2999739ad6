"""Draws docs/images/overview.png and dynamics.png anew: runs the demonstration and photographs its pages.

From the repository: `.venv/bin/python -P docs/images/render_pages.py`. It takes three minutes, and Debian's
chromium.
"""

import shutil
import time
from pathlib import Path

import click
from playwright.sync_api import sync_playwright

from daemon.cli.simulate.demo import demo_machine, page_address, tune_spindle_speed
from daemon.simulation.demonstration import switch_on, watch
from daemon.simulation.processes import folder_for, port_from, start_simulation, write_simulation_configuration

FOLDER = Path(__file__).parent
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
PICTURES = (("overview", "light", 1280, 1290), ("dynamics", "dark", 1280, 880))
"""Page, colours, width and height [pixel]."""


@click.command()
@click.option("--minutes", type=float, default=65.0, show_default=True, help="Simulated minutes until the pictures.")
@click.option("--speed", type=float, default=30.0, show_default=True, help="Simulated seconds per second.")
def draw(minutes: float, speed: float) -> None:
    """Run the demonstration and write the pictures beside this script."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise click.ClickException("there is no chromium on this computer: apt install chromium")
    port = port_from(8080)
    with folder_for(None) as folder:
        machine = demo_machine()
        tune_spindle_speed(machine)
        path, _ = write_simulation_configuration(machine, folder, speed=speed, http_port=port)
        with start_simulation([], path, speed=speed, epoch_utc_s=time.time(), directory=folder) as running:
            switch_on(running)
            watch(running, minutes * 60.0, lambda _: None, 5.0)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
                for name, scheme, width, height in PICTURES:
                    context = browser.new_context(
                        viewport={"width": width, "height": height},
                        color_scheme="light" if scheme == "light" else "dark",
                    )
                    page = context.new_page()
                    page.goto(f"{page_address(port)}#/{name}")
                    page.wait_for_selector("canvas")
                    page.wait_for_timeout(2000)
                    page.screenshot(path=FOLDER / f"{name}.png")
                    click.echo(f"{FOLDER / name}.png")
                browser.close()


if __name__ == "__main__":
    draw()
