"""Intents whose outcome a crash has swallowed, settled by what the CNC holds at the start."""

import structlog

from daemon.history.writer import HistoryWriter
from daemon.output.macro_block import Echo
from models.records import CncSample, Instant, Receipt, Trace, WriteOutcome

log = structlog.get_logger(__name__)

SAME = 1e-6
"""Largest difference between a macro as written and as found."""


def settle_unsettled(history: HistoryWriter, sample: CncSample, echo: Echo, now: Instant) -> None:
    """Give every intent without an outcome the one that reading back at the start shows.

    Only the newest intent can still be found in the CNC; an older one was overwritten by writes
    that have outcomes of their own, or by the newest.
    """
    for record in history.unsettled_writes():
        found = tuple(sample.macros.get(number) for number, _ in record.macros)
        whole = all(
            value is not None and abs(value - written) <= SAME * max(1.0, abs(written))
            for value, (_, written) in zip(found, record.macros, strict=True)
        )
        outcome = WriteOutcome.VERIFIED if whole else WriteOutcome.FAILED
        how = "it arrived whole" if whole else "the CNC holds other values"
        if any(number not in sample.macros for number, _ in record.macros):
            how = "these macros are not polled; whoever owns them writes them anew"
        receipt = Receipt(
            sequence=record.sequence or 0,
            macros=record.macros,
            outcome=outcome,
            detail=f"the daemon ended while writing; read back at the start: {how}",
            read_back=found,
            applied_um=echo.applied_um,
            trace=Trace(first_byte=now, last_byte=now, read_back=now),
        )
        history.write_outcome(record.write_id, receipt)
        log.warning("audit.settled", write=record.write_id, outcome=outcome.name.lower())
