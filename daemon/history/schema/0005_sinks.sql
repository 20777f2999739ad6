-- Schema 5. What sinks read in order of row: numbers of rows are never given twice, a packed hour knows its last one,
-- and a store its generation, which changes when it is begun anew or restored.
CREATE TABLE temperature_cycles_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    layout_id INTEGER NOT NULL,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    number INTEGER NOT NULL,
    duration_ms INTEGER NOT NULL,
    complete INTEGER NOT NULL,
    faults TEXT,
    counts BLOB NOT NULL,
    flags BLOB
);
INSERT INTO temperature_cycles_5 SELECT * FROM temperature_cycles;
DROP TABLE temperature_cycles;
ALTER TABLE temperature_cycles_5 RENAME TO temperature_cycles;
CREATE INDEX temperature_cycles_by_time ON temperature_cycles (layout_id, utc_ms);

CREATE TABLE cnc_samples_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    mode TEXT NOT NULL,
    run TEXT NOT NULL,
    alarm INTEGER NOT NULL,
    program INTEGER NOT NULL,
    sequence_number INTEGER NOT NULL,
    spindle_speed_rpm REAL,
    motor_temperature_degc REAL,
    clock_ms REAL,
    power_on_count INTEGER NOT NULL,
    work_offset INTEGER NOT NULL,
    tool_number INTEGER NOT NULL,
    macros TEXT NOT NULL
);
INSERT INTO cnc_samples_5 SELECT * FROM cnc_samples;
DROP TABLE cnc_samples;
ALTER TABLE cnc_samples_5 RENAME TO cnc_samples;
CREATE INDEX cnc_samples_by_time ON cnc_samples (utc_ms);

CREATE TABLE displacements_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    um TEXT NOT NULL,
    reasons TEXT,
    source TEXT NOT NULL
);
INSERT INTO displacements_5 SELECT * FROM displacements;
DROP TABLE displacements;
ALTER TABLE displacements_5 RENAME TO displacements;
CREATE INDEX displacements_by_time ON displacements (utc_ms);

CREATE TABLE estimates_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    line TEXT NOT NULL,
    cycle_utc_ms INTEGER NOT NULL,
    delay_us REAL,
    thermal_error_um TEXT NOT NULL,
    band_um TEXT NOT NULL,
    label_degc TEXT NOT NULL,
    label_reference_degc TEXT NOT NULL,
    in_domain INTEGER NOT NULL,
    confidence REAL,
    imputed TEXT NOT NULL,
    model_id TEXT NOT NULL,
    reference_id TEXT
);
INSERT INTO estimates_5 SELECT * FROM estimates;
DROP TABLE estimates;
ALTER TABLE estimates_5 RENAME TO estimates;
CREATE INDEX estimates_by_time ON estimates (utc_ms);

CREATE TABLE events_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    kind TEXT NOT NULL,
    text TEXT NOT NULL,
    person TEXT
);
INSERT INTO events_5 SELECT * FROM events;
DROP TABLE events;
ALTER TABLE events_5 RENAME TO events;
CREATE INDEX events_by_time ON events (utc_ms);

CREATE TABLE reference_points_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    reference_id TEXT NOT NULL,
    monotonic_s REAL NOT NULL,
    utc_s REAL NOT NULL,
    real_s REAL NOT NULL,
    source TEXT NOT NULL,
    layout_id INTEGER NOT NULL,
    degc BLOB NOT NULL,
    program INTEGER NOT NULL,
    work_offset INTEGER NOT NULL,
    power_on_count INTEGER NOT NULL
);
INSERT INTO reference_points_5 SELECT * FROM reference_points;
DROP TABLE reference_points;
ALTER TABLE reference_points_5 RENAME TO reference_points;
CREATE INDEX reference_points_by_time ON reference_points (utc_ms);

CREATE TABLE probes_5 (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    axis TEXT NOT NULL,
    deviation_um REAL NOT NULL,
    applied_um REAL,
    thermal_error_um REAL,
    reference_id TEXT,
    accepted INTEGER NOT NULL,
    reason TEXT NOT NULL
);
INSERT INTO probes_5 SELECT * FROM probes;
DROP TABLE probes;
ALTER TABLE probes_5 RENAME TO probes;
CREATE INDEX probes_by_time ON probes (utc_ms);

-- NULL in what was packed before.
ALTER TABLE chunks ADD COLUMN last_row_id INTEGER;
CREATE INDEX chunks_by_last_row ON chunks (kind, last_row_id);

CREATE TABLE generation (
    text TEXT NOT NULL
);
INSERT INTO generation (text) VALUES (lower(hex(randomblob(16))));
