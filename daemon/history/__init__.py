"""The history store, one SQLite file: what was measured, estimated, requested, written and applied, and by whom.

`HistoryWriter` owns the only connection that writes, in a thread of its own; `HistoryReader` reads from any process
meanwhile. Whole hours are packed into column chunks, which the reader does not show.
"""
