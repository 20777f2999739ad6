"""A displacement file for tests, its rows, and a source that follows it."""

import asyncio
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from config.schema.displacements import DisplacementsConfig
from drivers.clock import SystemClock
from drivers.displacement.source import DisplacementCsvSource
from models.records import DisplacementSample

PATIENCE_S = 20.0
T0 = datetime(2026, 1, 31, 8, 0, tzinfo=UTC).timestamp()
HEADER = "time,Y1,Z1\n"


def config(path: Path, **file: Any) -> DisplacementsConfig:
    channels = file.pop("channels", [{"name": "Y", "column": "Y1"}, {"name": "Z", "column": "Z1"}])
    file = {"path": path, "header": "time", "poll_period_s": 0.01, **file}
    return DisplacementsConfig.model_validate({"file": file, "channels": channels})


def row(minute: int, y: object = 1.5, z: object = -2.25) -> str:
    stamp = datetime.fromtimestamp(T0 + 60 * minute, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{stamp},{y},{z}\n"


def append(path: Path, text: str | bytes) -> None:
    with path.open("ab") as file:
        file.write(text if isinstance(text, bytes) else text.encode())


class Follower:
    """A source and the samples it has given."""

    def __init__(self, config: DisplacementsConfig, after_utc_s: float | None = None) -> None:
        self.source = DisplacementCsvSource(config, SystemClock(), after_utc_s=after_utc_s)
        self.samples: list[DisplacementSample] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> "Follower":
        self._task = asyncio.create_task(self._follow())
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.source.close()
        assert self._task is not None
        await asyncio.wait_for(self._task, PATIENCE_S)

    async def _follow(self) -> None:
        async for sample in self.source.samples():
            self.samples.append(sample)

    async def until(self, samples: int | None = None, problems: int | None = None) -> list[DisplacementSample]:
        async with asyncio.timeout(PATIENCE_S):
            while (samples is not None and len(self.samples) < samples) or (
                problems is not None and self.source.problems < problems
            ):
                assert self._task is not None
                if self._task.done():
                    self._task.result()
                await asyncio.sleep(0.005)
        return self.samples

    async def settle(self) -> list[DisplacementSample]:
        """Let the source look a few more times."""
        await asyncio.sleep(0.1)
        return self.samples


def minutes(samples: list[DisplacementSample]) -> list[float]:
    return [(sample.utc_s - T0) / 60 for sample in samples]


async def read_all(config: DisplacementsConfig, samples: int, problems: int = 0) -> tuple[Follower, list[Any]]:
    async with Follower(config) as follower:
        await follower.until(samples, problems)
        await follower.settle()
    assert len(follower.samples) == samples
    assert follower.source.problems == problems, follower.source.last_problem
    return follower, [[None if math.isnan(um) else um for um in sample.um] for sample in follower.samples]
