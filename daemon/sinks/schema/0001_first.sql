-- Schema 1. One row per record of the history of a machine, the same names and units. Where `monotonic_ms` is part of a
-- key it keeps rows apart whose time of day is the same because a clock was set back. JSON objects go by name.
CREATE TABLE temperatures (
    machine text NOT NULL,
    time timestamptz NOT NULL,            -- first byte of the cycle
    monotonic_ms bigint NOT NULL,
    line text NOT NULL,
    number bigint NOT NULL,
    duration_ms integer NOT NULL,
    complete boolean NOT NULL,
    faults jsonb,
    sensor_ids integer[] NOT NULL,
    degc real[] NOT NULL,                 -- in the order of sensor_ids; null where there is none
    quality smallint[] NOT NULL,          -- 0 good, 1 held, 2 missing
    reason smallint[] NOT NULL,
    PRIMARY KEY (machine, line, time, monotonic_ms, number)
) PARTITION BY RANGE (time);

CREATE TABLE estimates (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    monotonic_ms bigint NOT NULL,
    line text NOT NULL,
    cycle_time timestamptz NOT NULL,
    delay_us double precision,
    thermal_error_um jsonb NOT NULL,
    band_um jsonb NOT NULL,
    label_degc jsonb NOT NULL,
    label_reference_degc jsonb NOT NULL,
    in_domain boolean NOT NULL,
    confidence double precision,
    imputed jsonb NOT NULL,
    model_id text NOT NULL,
    reference_id text,
    PRIMARY KEY (machine, line, time, monotonic_ms)
) PARTITION BY RANGE (time);

CREATE TABLE writes (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    monotonic_ms bigint NOT NULL,
    write_id bigint NOT NULL,
    cause text NOT NULL,
    person text,
    state text,
    reason text,
    requested_um jsonb,
    compensation_um jsonb,
    enable jsonb,
    limits_hit jsonb,
    macros jsonb NOT NULL,
    outcome text NOT NULL,                -- intended, verified, differs, failed, refused
    sequence double precision,
    detail text,
    read_back jsonb,
    applied_um jsonb,
    outcome_after_ms double precision,
    cycle_age_ms double precision,
    cleansed_us double precision,
    estimated_us double precision,
    written_us double precision,
    read_back_us double precision,
    echoed_after_ms double precision,
    PRIMARY KEY (machine, time, write_id)
) PARTITION BY RANGE (time);

CREATE TABLE cnc (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    monotonic_ms bigint NOT NULL,
    mode text NOT NULL,
    run text NOT NULL,
    alarm boolean NOT NULL,
    program bigint NOT NULL,
    sequence_number bigint NOT NULL,
    spindle_speed_rpm double precision,
    motor_temperature_degc double precision,
    clock_ms double precision,
    power_on_count bigint NOT NULL,
    work_offset bigint NOT NULL,
    tool_number bigint NOT NULL,
    macros jsonb NOT NULL,
    PRIMARY KEY (machine, time, monotonic_ms)
) PARTITION BY RANGE (time);

CREATE TABLE displacements (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    um jsonb NOT NULL,
    reasons jsonb,
    source text NOT NULL,
    PRIMARY KEY (machine, time, source)
) PARTITION BY RANGE (time);

CREATE TABLE events (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    monotonic_ms bigint NOT NULL,
    kind text NOT NULL,
    text text NOT NULL,
    person text
);
CREATE UNIQUE INDEX events_key ON events (machine, time, monotonic_ms, kind, md5(text));

CREATE TABLE probes (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    monotonic_ms bigint NOT NULL,
    axis text NOT NULL,
    deviation_um double precision NOT NULL,
    applied_um double precision,
    thermal_error_um double precision,
    reference_id text,
    accepted boolean NOT NULL,
    reason text NOT NULL,
    PRIMARY KEY (machine, time, monotonic_ms, axis)
);

-- PostgreSQL reserves the word `references`.
CREATE TABLE reference_points (
    machine text NOT NULL,
    time timestamptz NOT NULL,
    reference_id text NOT NULL,
    source text NOT NULL,
    sensor_ids integer[] NOT NULL,
    degc real[] NOT NULL,
    program bigint NOT NULL,
    work_offset bigint NOT NULL,
    power_on_count bigint NOT NULL,
    PRIMARY KEY (machine, time, reference_id)
);

-- How far each machine's stream has come, set in the transaction that brought its rows.
CREATE TABLE deliveries (
    machine text NOT NULL,
    stream text NOT NULL,
    generation text NOT NULL,             -- of the machine's store
    last_row bigint NOT NULL,
    last_chunk bigint NOT NULL,
    newest timestamptz NOT NULL,
    delivered timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (machine, stream)
);

-- One row per sensor, for charts.
CREATE VIEW sensor_temperatures AS
    SELECT t.machine, t.time, t.line, s.sensor_id, s.degc, s.quality, s.reason
    FROM temperatures AS t,
         unnest(t.sensor_ids, t.degc, t.quality, t.reason) AS s (sensor_id, degc, quality, reason);
