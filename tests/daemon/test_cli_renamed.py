"""Commands say which names of keys and options are old."""

from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from config.sample import sample_configuration
from daemon.cli import main


@pytest.fixture
def old_file(tmp_path: Path) -> Path:
    content = yaml.safe_load(sample_configuration())
    del content["cnc"]["guard"]["max_validity_s"]
    content["cnc"]["guard"]["look_ahead_s"] = 120.0
    content["history"]["path"] = str(tmp_path / "toolpoint.yaml" / "no-folder" / "history.sqlite")
    path = tmp_path / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


WARNING = "cnc.guard.look_ahead_s: write `cnc.guard.max_validity_s`; the old name works in this version only"


def test_check_prints_a_warning_for_an_old_key(old_file: Path) -> None:
    done = CliRunner().invoke(main, ["check", "--no-devices", "--config", str(old_file)])
    assert f"warning: {old_file}:" in done.stderr
    assert WARNING in done.stderr
    assert WARNING not in done.stdout


@pytest.mark.parametrize("word", ["--within-percent", "--within-percent=20"])
def test_an_old_option_is_taken_with_a_warning(word: str) -> None:
    done = CliRunner().invoke(main, ["stability", "choose", word, *([] if "=" in word else ["20"]), "--help"])
    assert done.exit_code == 0
    assert "warning: --within-percent is called --max-change-percent now" in done.stderr
