"""Sinks: what the history store holds goes to systems of others, in a process of its own that reads the store.

The store is the outbox. Each sink has a cursor, which moves when the sink has acknowledged; every row has a key that
makes repeats harmless. The daemon knows nothing of this process but the cursors, for which its retention waits.
"""
