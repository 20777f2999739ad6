"""A model is loaded beside the loop: what comes back, and what many requests at once lead to."""

import asyncio
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import machine
from small_model import model

from config.schema import Configuration
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import LoadedModel, load_released
from daemon.model_release.reload import ModelReload, load_beside
from daemon.model_release.side_load import pack, unpack
from daemon.snapshots import ModelSnapshot
from models.thermal.family import ThermalModel

FOREVER_S = 60.0


def configured(folder: Path, text: str) -> Configuration:
    path = folder / "model.json"
    path.write_text(text, encoding="utf-8")
    before = machine(folder)
    changed = before.compensation.model_copy(update={"model_file": path, "allow_writable_model_directory": True})
    return before.model_copy(update={"compensation": changed})


async def test_it_gives_what_loading_in_the_loop_gives(tmp_path: Path) -> None:
    configuration = configured(tmp_path, model("ridge-7").to_json())
    here, beside = load_released(configuration, own_account()), await load_beside(configuration)
    assert here.model is not None and beside.model is not None
    assert replace(here, model=None) == replace(beside, model=None)
    assert beside.model.to_json() == here.model.to_json()
    assert beside.in_words() == here.in_words() and "ridge-7" in here.in_words()


def test_arrays_of_a_mapped_model_cannot_be_written(tmp_path: Path) -> None:
    made = LoadedModel(model=model(), inhibit="", sha256="0" * 64)
    descriptor = os.memfd_create("test")
    with os.fdopen(descriptor, "wb", buffering=0, closefd=False) as file:
        pack(made, file)  # type: ignore[arg-type]
        file.truncate()
    found = unpack(descriptor).model
    os.close(descriptor)
    assert found is not None and made.model is not None
    assert np.array_equal(found.solutions[0].weights, made.model.solutions[0].weights)
    with pytest.raises(ValueError, match="read-only"):
        found.solutions[0].weights[0] = 0.0


class Shelf:
    """A released model and loads that end when a test lets them."""

    def __init__(self, loaded: LoadedModel[ThermalModel]) -> None:
        self.released: LoadedModel[ThermalModel] = loaded
        self.begun: asyncio.Queue[int] = asyncio.Queue()
        self.let_end: asyncio.Queue[None] = asyncio.Queue()
        self.loads = 0
        self.taken: list[ThermalModel] = []
        self.events: list[str] = []
        self.shown: list[ModelSnapshot] = []
        self.published = asyncio.Event()
        self.reload = ModelReload(
            loaded, self._load, take=self.taken.append, report=self._report, publish=self._publish
        )

    async def _load(self) -> LoadedModel[ThermalModel]:
        found = self.released
        self.loads += 1
        self.begun.put_nowait(self.loads)
        await self.let_end.get()
        return found

    def _report(self, _kind: str, text: str) -> None:
        self.events.append(text)

    def _publish(self, snapshot: ModelSnapshot) -> None:
        self.shown.append(snapshot)
        self.published.set()

    async def publication(self) -> ModelSnapshot:
        async with asyncio.timeout(FOREVER_S):
            await self.published.wait()
        self.published.clear()
        return self.shown[-1]


def found(name: str, sha256: str) -> LoadedModel[ThermalModel]:
    return LoadedModel(model=model(name), inhibit="", sha256=sha256 * 64)


@pytest.fixture
async def shelf() -> Any:
    made = Shelf(found("first", "1"))
    running = asyncio.create_task(made.reload.run())
    yield made
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


async def test_a_request_while_a_model_is_loaded_leads_to_one_more_load_that_sees_the_newest(shelf: Shelf) -> None:
    shelf.released = found("second", "2")
    shelf.reload.request()
    assert await shelf.begun.get() == 1
    shelf.released = found("third", "3")
    for _ in range(5):
        shelf.reload.request()
    shelf.let_end.put_nowait(None)
    assert (await shelf.publication()).model_id == "second"
    assert await shelf.begun.get() == 2
    shelf.let_end.put_nowait(None)
    assert (await shelf.publication()).model_id == "third"
    assert [each.model_id for each in shelf.taken] == ["second", "third"] and shelf.loads == 2


async def test_a_refused_release_is_shown_until_what_is_released_is_in_force_again(shelf: Shelf) -> None:
    shelf.released = LoadedModel(model=None, inhibit="nobody has released this model")
    shelf.reload.request()
    shelf.let_end.put_nowait(None)
    refused = await shelf.publication()
    assert (refused.model_id, refused.problem) == ("first", "nobody has released this model")
    assert shelf.events == ["refused: nobody has released this model; the model in use stays"]
    shelf.released = found("first", "1")
    shelf.reload.request()
    shelf.let_end.put_nowait(None)
    assert (await shelf.publication()).problem == ""
    assert shelf.taken == [] and len(shelf.events) == 1


async def test_a_defect_in_loading_leaves_the_model_in_use() -> None:
    async def broken() -> LoadedModel[ThermalModel]:
        raise ZeroDivisionError("made up")

    shelf = Shelf(found("first", "1"))
    reload = ModelReload(
        found("first", "1"), broken, take=shelf.taken.append, report=shelf._report, publish=shelf._publish
    )
    running = asyncio.create_task(reload.run())
    reload.request()
    assert "unexpected ZeroDivisionError while loading: made up" in (await shelf.publication()).problem
    assert shelf.taken == []
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
