"""A model is released while the machine runs: the daemon takes it up, the output does not jump."""

import json
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from heaps import thread_heaps
from wires import EVER, FOREVER_S, check_audit, on_wires

from config.machines import shipped_file
from daemon.cli import main
from daemon.history import HistoryReader
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel

pytestmark = [pytest.mark.wires, pytest.mark.slow]


def toolpoint(*arguments: str, config: Path) -> Any:
    """Run `toolpoint model ...`; return what it writes as JSON."""
    answer = config.with_name("answer.json")
    finished = CliRunner().invoke(main, ["model", *arguments, "--config", str(config), "--json", str(answer)])
    assert finished.exit_code == 0, finished.output
    return json.loads(answer.read_text(encoding="utf-8"))


def other_model() -> LinearModel:
    """Return the shipped model with every coefficient half as large again: its estimate would jump by half."""
    shipped = model_from_json(shipped_file("simulated_machine_model.json").read_text("utf-8"), "shipped")
    assert isinstance(shipped, LinearModel) and not shipped.drift_um_per_min.any()
    solutions = tuple(replace(one, weights=1.5 * one.weights) for one in shipped.solutions)
    vectors = tuple(replace(v, thermal_error_um=1.5 * v.thermal_error_um) for v in shipped.test_vectors)
    return replace(shipped, model_id="half-as-much-again", solutions=solutions, test_vectors=vectors)


def said_of_models(store: Path, last: str) -> list[str]:
    """Return the events about models once the last one begins so: the daemon commits them while we look."""
    end_s = time.monotonic() + FOREVER_S
    while True:
        with HistoryReader(store) as reader:
            said = [event.text for event in reader.events(*EVER) if event.kind == "model"]
        if (said and said[-1].startswith(last)) or time.monotonic() > end_s:
            return said
        time.sleep(0.05)


def test_a_model_released_meanwhile_is_taken_up_at_work(tmp_path: Path) -> None:
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    first.write_text(shipped_file("simulated_machine_model.json").read_text("utf-8"), "utf-8")
    second.write_text(other_model().to_json(), "utf-8")

    def change(content: dict[str, Any]) -> None:
        content["compensation"]["model_file"] = str(tmp_path / "models/model.json")
        (tmp_path / "toolpoint.yaml").write_text(json.dumps(content), encoding="utf-8")
        toolpoint("release", str(first), "--note", "first", config=tmp_path / "toolpoint.yaml")

    with on_wires(tmp_path, speed=60.0, change=change) as wires:
        config = tmp_path / "toolpoint.yaml"
        before = wires.switch_on()
        assert before["model"]["release"] == 1 and "uid" in before["model"]["released_by"]
        assert "allow_writable_model_directory" in before["model"]["warning"]
        assert before["output"]["writable_model_directory"] is True

        toolpoint("release", str(second), config=config)
        wires.running.daemon.send_signal(signal.SIGHUP)
        after = wires.wait(
            "the new model", lambda s: s["estimate"] is not None and s["estimate"]["model"] == "half-as-much-again"
        )
        assert after["model"]["release"] == 2
        wires.wait_for_state("ACTIVE")

        active = tmp_path / "models/releases/0002/model.json"
        active.write_text("{}", encoding="utf-8")
        wires.running.daemon.send_signal(signal.SIGHUP)
        broken = wires.wait("the refusal", lambda status: status["model"]["problem"] != "")
        assert "not the file that" in broken["model"]["problem"]
        assert broken["model"]["model_id"] == "half-as-much-again", "the one in use stays"
        listed = toolpoint("list", config=config)
        assert listed["active"] == 2 and [record["number"] for record in listed["releases"]] == [1, 2]
        back = toolpoint("rollback", "--to", "1", config=config)
        assert back["action"] == "rollback" and back["number"] == 3
        assert thread_heaps(wires.running.daemon.pid) == 0, "what one thread has freed serves the others"
        wires.check_nothing_broke()
        check_audit(wires.writes(), wires.configuration, begun_s=wires.begun_s())
        said = said_of_models(wires.configuration.history.path, "refused: ")
        # A simulation whose processes were not ready in time starts its daemon once more.
        first_said, second_said, third_said = said[-3:]
        assert first_said.startswith("ridge-") and "release 1 by " in first_said
        assert second_said.startswith("half-as-much-again, sha256 ") and "release 2 by " in second_said
        assert third_said.startswith("refused: ") and "the model in use stays" in third_said
