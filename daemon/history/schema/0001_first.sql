-- Schema 1. Times: `utc_ms` is UTC in whole milliseconds since 1970; `monotonic_ms` the same
-- moment on the machine's monotonic clock (its difference to utc_ms changes only when the
-- clock is set). JSON objects hold exact float64 numbers; null is vacant, or no number.
PRAGMA application_id = 1414547540;

-- Who stands at which position of a BLOB. A change of configuration makes a new layout.
CREATE TABLE layouts (
    layout_id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,              -- 'line' (sensor ids by chain position), 'machine' (sensor ids)
    name TEXT NOT NULL,
    members TEXT NOT NULL,           -- JSON list
    UNIQUE (kind, name, members)
);

-- One completed pass over one line.
CREATE TABLE temperature_cycles (
    id INTEGER PRIMARY KEY,
    layout_id INTEGER NOT NULL,
    utc_ms INTEGER NOT NULL,         -- first byte
    monotonic_ms INTEGER NOT NULL,
    number INTEGER NOT NULL,         -- count of cycles since the port was opened
    duration_ms INTEGER NOT NULL,    -- first to last byte
    complete INTEGER NOT NULL,
    faults TEXT,                     -- JSON list of sentences, NULL when there were none
    counts BLOB NOT NULL,            -- measured, int16 little-endian, 1/160 degC, -32768 none
    flags BLOB                       -- values that are not GOOD: u16 position, u8 quality, u8 reason
);
CREATE INDEX temperature_cycles_by_time ON temperature_cycles (layout_id, utc_ms);

CREATE TABLE cnc_samples (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    mode TEXT NOT NULL,
    run TEXT NOT NULL,
    alarm INTEGER NOT NULL,
    program INTEGER NOT NULL,
    sequence_number INTEGER NOT NULL,
    spindle_speed_rpm REAL,          -- to 0.01 rpm
    motor_temperature_degc REAL,     -- to 0.01 degC
    clock_ms REAL,                   -- the CNC's own clock
    power_on_count INTEGER NOT NULL,
    work_offset INTEGER NOT NULL,
    tool_number INTEGER NOT NULL,
    macros TEXT NOT NULL             -- JSON object: macro number -> value
);
CREATE INDEX cnc_samples_by_time ON cnc_samples (utc_ms);

CREATE TABLE displacements (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    um TEXT NOT NULL,                -- JSON object: channel -> um
    reasons TEXT,                    -- JSON object: channel -> reason code, NULL when all are accepted
    source TEXT NOT NULL             -- file and line
);
CREATE INDEX displacements_by_time ON displacements (utc_ms);

CREATE TABLE estimates (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,         -- when the estimate was ready
    monotonic_ms INTEGER NOT NULL,
    line TEXT NOT NULL,              -- whose cycle renewed it
    cycle_utc_ms INTEGER NOT NULL,   -- first byte of that cycle
    delay_us REAL,                   -- last byte to estimate, on the computer's clock, to 10 us
    thermal_error_um TEXT NOT NULL,  -- JSON objects: channel -> um, to 0.001 um
    band_um TEXT NOT NULL,
    label_degc TEXT NOT NULL,        -- JSON objects: label -> degC, to 0.001 degC
    label_reference_degc TEXT NOT NULL, -- what label_degc was at the reference
    in_domain INTEGER NOT NULL,
    confidence REAL,                 -- to 0.0001
    imputed TEXT NOT NULL,           -- JSON list of sensor ids
    model_id TEXT NOT NULL,
    reference_id TEXT
);
CREATE INDEX estimates_by_time ON estimates (utc_ms);

-- The audit of macro writes: the intent is inserted before, the outcome set after the write.
CREATE TABLE writes (
    write_id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,         -- intent
    monotonic_ms INTEGER NOT NULL,
    cause TEXT NOT NULL,
    person TEXT,
    state TEXT,
    reason TEXT,
    requested_um TEXT,               -- JSON objects: axis -> um, to 0.001 um
    compensation_um TEXT,
    enable TEXT,                     -- JSON list
    limits_hit TEXT,                 -- JSON list
    macros TEXT NOT NULL,            -- JSON object: macro number -> value, in the order written
    outcome INTEGER NOT NULL DEFAULT 0,
    sequence REAL,
    detail TEXT,
    read_back TEXT,                  -- JSON object, NULL where the outcome is set: exactly as written
    applied_um TEXT,                 -- JSON object: axis -> the guard's echo
    outcome_after_ms REAL,           -- after the intent
    cycle_age_ms REAL,               -- from the first byte of the cycle behind it to the intent
    cleansed_us REAL,                -- from that cycle's last byte to each stage, to 10 us
    estimated_us REAL,
    written_us REAL,
    read_back_us REAL
);
CREATE INDEX writes_by_time ON writes (utc_ms);
CREATE INDEX writes_unsettled ON writes (write_id) WHERE outcome = 0;

-- Operator actions, state changes, alarms.
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    kind TEXT NOT NULL,
    text TEXT NOT NULL,
    person TEXT
);
CREATE INDEX events_by_time ON events (utc_ms);

CREATE TABLE reference_points (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    reference_id TEXT NOT NULL,
    monotonic_s REAL NOT NULL,
    utc_s REAL NOT NULL,
    real_s REAL NOT NULL,
    source TEXT NOT NULL,
    layout_id INTEGER NOT NULL,
    degc BLOB NOT NULL,              -- float64 little-endian, machine order
    program INTEGER NOT NULL,
    work_offset INTEGER NOT NULL,
    power_on_count INTEGER NOT NULL
);
CREATE INDEX reference_points_by_time ON reference_points (utc_ms);

-- What the daemon takes up again after a restart.
CREATE TABLE state (
    key TEXT PRIMARY KEY,
    json TEXT NOT NULL,
    utc_ms INTEGER NOT NULL
);

-- The last cycle of each line whose commit has returned.
CREATE TABLE acknowledged (
    line TEXT PRIMARY KEY,
    number INTEGER NOT NULL,
    utc_ms INTEGER NOT NULL
);

-- Older whole hours, packed; their rows are gone from the tables above.
CREATE TABLE chunks (
    chunk_id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,
    layout_id INTEGER NOT NULL,      -- 0 but for temperatures
    start_ms INTEGER NOT NULL,       -- first and last utc_ms in it, both within one hour
    end_ms INTEGER NOT NULL,
    row_count INTEGER NOT NULL,
    data BLOB NOT NULL
);
CREATE INDEX chunks_by_time ON chunks (kind, layout_id, start_ms);
