"""Takes up the thermal model that is released while the daemon works."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

import structlog

from config.schema import Configuration
from daemon.model_release.loading import LoadedModel
from daemon.snapshots import ModelSnapshot
from models.thermal.family import ThermalModel

log = structlog.get_logger(__name__)

Load = Callable[[], Awaitable[LoadedModel[ThermalModel]]]
"""Loads what is released now, off the loop."""


class ModelReload:
    """Holds the model in force; `request` may be called at any time, also while a model is being loaded."""

    def __init__(
        self,
        loaded: LoadedModel[ThermalModel],
        load: Load,
        *,
        take: Callable[[ThermalModel], None],
        report: Callable[[str, str], None],
        publish: Callable[[ModelSnapshot], None],
    ) -> None:
        """`take` gets a model that differs from the one in force; `report` the kind of an event and its text."""
        self._loaded = loaded
        self._load = load
        self._take = take
        self._report = report
        self._publish = publish
        self._asked = asyncio.Event()

    def request(self) -> None:
        """Ask for a look at what is released; requests that come before the look begins count once."""
        self._asked.set()

    async def run(self) -> None:
        """Serve requests until cancelled; a load under way is then given up, and nothing of it is taken."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            try:
                found = await self._load()
            except Exception as error:
                log.exception("model.defect")
                found = LoadedModel(model=None, inhibit=f"unexpected {type(error).__name__} while loading: {error}")
            self._take_up(found)

    def _take_up(self, found: LoadedModel[ThermalModel]) -> None:
        """Take up a model that was released meanwhile; the old one stays where the new one is refused."""
        if found.model is not None and self._loaded.model is None:
            words = f"{found.in_words()}; the daemon was started without a model: restart it to use this one"
        elif found.model is not None and found.sha256 == self._loaded.sha256:
            log.info("model.reload", outcome="unchanged")
            self._publish(self._loaded.snapshot())
            return
        elif found.model is not None:
            words = found.in_words()
            self._loaded = found
            self._publish(found.snapshot())
            self._take(found.model)
        else:
            words = f"{found.in_words()}; the model in use stays"
            self._publish(replace(self._loaded.snapshot(), problem=found.inhibit))
        log.info("model.reload", outcome=words)
        self._report("model", words)


async def load_beside(configuration: Configuration) -> LoadedModel[ThermalModel]:
    """Return the released model, loaded in a process beside the daemon, or why there is none."""
    from daemon.model_release import side_load  # noqa: PLC0415 - used by a release alone

    return await side_load.load_beside(configuration)
