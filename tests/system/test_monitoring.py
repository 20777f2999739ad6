"""The dashboard for Grafana and the rules for Prometheus: sound by promtool, and of metrics that are served."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from daemon.monitor.web.metrics import OF_AXES
from daemon.telemetry.metrics import Telemetry

FOLDER = Path(__file__).parents[2] / "systemd" / "monitoring"
PROMTOOL = shutil.which("promtool")
needs_promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (Debian: prometheus)")
PRESENT = {"toolpoint_output_state_number", "toolpoint_temperatures_age_seconds", "toolpoint_temperature_celsius"}


def served() -> set[str]:
    families = list(Telemetry().registry.collect())
    names = {f"{family.name}_total" if family.type == "counter" else family.name for family in families}
    names |= {f"{family.name}_bucket" for family in families if family.type == "histogram"}
    return names | PRESENT | {name for name, _ in OF_AXES.values()}


def expressions() -> Iterator[tuple[str, str]]:
    dashboard = json.loads((FOLDER / "grafana-dashboard.json").read_text("utf-8"))
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"]
    rules = yaml.safe_load((FOLDER / "toolpoint.rules.yml").read_text("utf-8"))
    for rule in rules["groups"][0]["rules"]:
        yield rule["alert"], rule["expr"]


def test_every_metric_that_is_asked_for_is_served() -> None:
    asked = {name for _, expression in expressions() for name in re.findall(r"toolpoint_\w+", expression)}
    assert asked and asked <= served()


@needs_promtool
def test_the_rules_are_sound_and_fire_when_they_should() -> None:
    for words in (("check", "rules", "toolpoint.rules.yml"), ("test", "rules", "toolpoint.rules.test.yml")):
        done = subprocess.run([str(PROMTOOL), *words], cwd=FOLDER, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@needs_promtool
def test_every_expression_of_the_dashboard_is_one(tmp_path: Path) -> None:
    rules = [
        {"record": f"dashboard:{number}", "expr": expression.replace("$machine", ".*")}
        for number, (_, expression) in enumerate(expressions())
    ]
    path = tmp_path / "dashboard.yml"
    path.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}), encoding="utf-8")
    done = subprocess.run([str(PROMTOOL), "check", "rules", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@needs_promtool
def test_the_metrics_are_as_prometheus_reads_them() -> None:
    from prometheus_client import generate_latest

    text = generate_latest(Telemetry().registry)
    done = subprocess.run([str(PROMTOOL), "check", "metrics"], input=text, capture_output=True, check=False)
    assert b"error" not in done.stderr.lower(), done.stderr
