-- Schema 2. What a probe in the NC program measured, and what was known at that moment.
CREATE TABLE probes (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    axis TEXT NOT NULL,
    deviation_um REAL NOT NULL,      -- actual minus nominal, with what was applied
    applied_um REAL,                 -- the guard's echo
    thermal_error_um REAL,           -- the estimate since the reference
    reference_id TEXT,
    accepted INTEGER NOT NULL,       -- 1: it corrects the estimate from now on
    reason TEXT NOT NULL             -- why it was refused, '' when it was not
);
CREATE INDEX probes_by_time ON probes (utc_ms);
