"""What many files of tests begin with; a file that begins with another one has a fixture of the same name."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from control_rig import Bench, Rig, running
from dynamics_command import DIRECT
from installation import Installation
from model_folder import open_folder
from thermal_rig import Task, model


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.fixture
async def rig(bench: Bench) -> AsyncIterator[Rig]:
    async with running(bench.rig()) as rig:
        yield rig


@pytest.fixture
def task(tmp_path: Path) -> Iterator[Task]:
    task = Task(tmp_path, model())
    task.history.start()
    yield task
    task.history.close()


@pytest.fixture
def folder() -> Iterator[Path]:
    with open_folder() as made:
        yield made


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    made = Installation(tmp_path / "here")
    made.fill()
    return made


@pytest.fixture
def spindle(tmp_path: Path) -> Path:
    path = tmp_path / "spindle.yaml"
    path.write_text(DIRECT)
    return path
