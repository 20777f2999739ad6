"""What the page about Python shows works, as it stands there, one block after the other."""

import re
import time
from importlib.util import find_spec
from pathlib import Path

import history_records as make
import pytest
import yaml
from history_records import SMALL, StillClock

from config.machines import shipped_file
from config.sample import sample_configuration
from daemon.history.writer import HistoryWriter

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "use-from-python.md"


def test_every_block_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = yaml.safe_load(sample_configuration())
    content["history"] = {"path": str(tmp_path / "history.sqlite")}
    content["service"] = {"socket": str(tmp_path / "control.sock")}
    content["compensation"]["model_file"] = str(shipped_file("simulated_machine_model.json"))
    (tmp_path / "toolpoint.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    now_s = time.time()
    writer = HistoryWriter(tmp_path / "history.sqlite", clock=StillClock(now_s - 60.0), machine=SMALL)
    writer.start()
    writer.temperatures(None, make.cycle("spindle", 1, now_s - 60.0, [23.0, 21.0, 22.0]))
    writer.event("note", "the coolant was changed", "anna").result(30)
    writer.close()
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    said = capsys.readouterr().out
    for words in ("spindle", "23.", "the coolant was changed anna", "Z1", "no daemon answers"):
        assert words in said, words


@pytest.mark.parametrize("package", ["models", "drivers", "config", "daemon"])
def test_packages_are_marked_as_typed(package: str) -> None:
    spec = find_spec(package)
    assert spec is not None and spec.submodule_search_locations is not None
    assert (Path(spec.submodule_search_locations[0]) / "py.typed").is_file()
