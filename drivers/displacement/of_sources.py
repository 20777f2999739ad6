"""Displacements that come over the wires that temperatures come over, and rows of several sources side by side."""

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing

import numpy as np

from drivers.contract import DisplacementSource
from drivers.readings import RowSource
from models.quality import Reason
from models.records import OF_SOURCE, DisplacementSample


class SourceDisplacements:
    """The channels of one source (`drivers.contract.DisplacementSource`), to be used once."""

    def __init__(self, source: RowSource) -> None:
        self.name = source.name
        self._source = source

    async def samples(
        self, on_problem: Callable[[str], None] = lambda _: None, on_reached: Callable[[], None] = lambda: None
    ) -> AsyncGenerator[DisplacementSample]:
        """Open the source and yield each row, at the time at which it was measured; raises LinkError."""
        async with aclosing(self._source.rows()) as rows:
            async for row in rows:
                on_reached()
                for fault in row.faults:
                    on_problem(fault)
                yield DisplacementSample(
                    utc_s=row.trace.first_byte.utc_s, um=row.values, reason=row.reason, source=f"{OF_SOURCE}{self.name}"
                )

    async def close(self) -> None:
        await self._source.close()


class AmongOthers:
    """One of several sources: its rows hold every channel, those of the others without a value."""

    def __init__(self, source: DisplacementSource, places: Sequence[int], count: int) -> None:
        self.name = source.name
        self._source = source
        self._places = list(places)
        self._count = count

    async def samples(
        self, on_problem: Callable[[str], None] = lambda _: None, on_reached: Callable[[], None] = lambda: None
    ) -> AsyncGenerator[DisplacementSample]:
        """Follow the source and yield each row once; raises LinkError."""
        samples = self._source.samples(on_problem, on_reached)
        try:
            async for sample in samples:
                um = np.full(self._count, np.nan)
                reason = np.full(self._count, Reason.ELSEWHERE, dtype=np.uint8)
                um[self._places], reason[self._places] = sample.um, sample.reason
                yield DisplacementSample(utc_s=sample.utc_s, um=um, reason=reason, source=sample.source)
        finally:
            await self._source.close()

    async def close(self) -> None:
        await self._source.close()
