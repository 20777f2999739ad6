-- Schema 4. Least, greatest and mean of every series in each packed hour, so that a year can be drawn at once.
-- A row belongs to a chunk and goes with it; chunks of before get theirs from housekeeping.
CREATE TABLE extremes (
    kind TEXT NOT NULL,
    layout_id INTEGER NOT NULL,      -- as in chunks
    hour_ms INTEGER NOT NULL,
    chunk_id INTEGER NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (kind, layout_id, hour_ms, chunk_id)
) WITHOUT ROWID;
