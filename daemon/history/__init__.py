"""The history store: what was measured, estimated, requested, written and applied, and by whom.

One SQLite file. `HistoryWriter` owns the only connection that writes, in a thread of its own;
`HistoryReader` opens the file read-only, from any process, while the daemon writes. Whole hours
that are old enough are packed into column chunks; the reader does not show the difference.
"""

from daemon.history.database import HistoryError
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter

__all__ = ["HistoryError", "HistoryReader", "HistoryWriter"]
