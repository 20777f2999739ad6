-- A store that version 0.1.0 wrote before schema 2: a few seconds of a machine that does not exist.
PRAGMA auto_vacuum=INCREMENTAL;
BEGIN TRANSACTION;
CREATE TABLE acknowledged (
    line TEXT PRIMARY KEY,
    number INTEGER NOT NULL,
    utc_ms INTEGER NOT NULL
);
INSERT INTO "acknowledged" VALUES('spindle',6,1760000460000);
INSERT INTO "acknowledged" VALUES('bed',6,1760000460000);
CREATE TABLE chunks (
    chunk_id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,
    layout_id INTEGER NOT NULL,      -- 0 but for temperatures
    start_ms INTEGER NOT NULL,       -- first and last utc_ms in it, both within one hour
    end_ms INTEGER NOT NULL,
    row_count INTEGER NOT NULL,
    data BLOB NOT NULL
);
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
INSERT INTO "cnc_samples" VALUES(1,1760000410000,1010000,'memory','start',0,1234,100,6000.0,41.0,87000.0,3,54,7,'{"600":0.012,"601":null}');
INSERT INTO "cnc_samples" VALUES(2,1760000420000,1020000,'memory','start',0,1234,100,6000.0,41.0,97000.0,3,54,7,'{"600":0.012,"601":null}');
INSERT INTO "cnc_samples" VALUES(3,1760000430000,1030000,'memory','start',0,1234,100,6000.0,41.0,107000.0,3,54,7,'{"600":0.012,"601":null}');
INSERT INTO "cnc_samples" VALUES(4,1760000440000,1040000,'memory','start',0,1234,100,6000.0,41.0,117000.0,3,54,7,'{"600":0.012,"601":null}');
INSERT INTO "cnc_samples" VALUES(5,1760000450000,1050000,'memory','start',0,1234,100,6000.0,41.0,127000.0,3,54,7,'{"600":0.012,"601":null}');
INSERT INTO "cnc_samples" VALUES(6,1760000460000,1060000,'memory','start',0,1234,100,6000.0,41.0,137000.0,3,54,7,'{"600":0.012,"601":null}');
CREATE TABLE displacements (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    um TEXT NOT NULL,                -- JSON object: channel -> um
    reasons TEXT,                    -- JSON object: channel -> reason code, NULL when all are accepted
    source TEXT NOT NULL             -- file and line
);
INSERT INTO "displacements" VALUES(1,1760000430000,'{"dx":1.0,"dy":2.0,"dz":3.0}',NULL,'/srv/logger/today.csv:2');
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
INSERT INTO "estimates" VALUES(1,1760000411501,1011501,'spindle',1760000410000,800.0,'{"dx":0.1,"dy":0.2,"dz":0.3}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
INSERT INTO "estimates" VALUES(2,1760000421501,1021501,'spindle',1760000420000,800.0,'{"dx":0.2,"dy":0.4,"dz":0.6}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
INSERT INTO "estimates" VALUES(3,1760000431501,1031501,'spindle',1760000430000,800.0,'{"dx":0.3,"dy":0.6,"dz":0.9}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
INSERT INTO "estimates" VALUES(4,1760000441501,1041501,'spindle',1760000440000,800.0,'{"dx":0.4,"dy":0.8,"dz":1.2}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
INSERT INTO "estimates" VALUES(5,1760000451501,1051501,'spindle',1760000450000,800.0,'{"dx":0.5,"dy":1.0,"dz":1.5}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
INSERT INTO "estimates" VALUES(6,1760000461501,1061501,'spindle',1760000460000,800.0,'{"dx":0.6,"dy":1.2,"dz":1.8}','{"dx":2.5,"dy":2.5,"dz":2.5}','{"A":25.125,"Room":21.5}','{"A":21.875,"Room":21.0}',1,0.987,'[12,21]','made-up','ref-1');
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    utc_ms INTEGER NOT NULL,
    monotonic_ms INTEGER NOT NULL,
    kind TEXT NOT NULL,
    text TEXT NOT NULL,
    person TEXT
);
INSERT INTO "events" VALUES(1,1760000400000,1000000,'daemon','started','daemon');
INSERT INTO "events" VALUES(2,1760000400000,1000000,'request','enable Z','anna (uid 1000, pid 42)');
CREATE TABLE layouts (
    layout_id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,              -- 'line' (sensor ids by chain position), 'machine' (sensor ids)
    name TEXT NOT NULL,
    members TEXT NOT NULL,           -- JSON list
    UNIQUE (kind, name, members)
);
INSERT INTO "layouts" VALUES(1,'machine','','[11, 12, 13, 21, 22]');
INSERT INTO "layouts" VALUES(2,'line','spindle','[13, 11, 12]');
INSERT INTO "layouts" VALUES(3,'line','bed','[21, 22]');
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
INSERT INTO "reference_points" VALUES(1,1760000405000,'ref-1',1005.0,1760000405.0,5005.0,'O1234 N10',1,X'0000000000003440000000000080364000000000000039400000000000803B400000000000003E40',1234,54,3);
CREATE TABLE state (
    key TEXT PRIMARY KEY,
    json TEXT NOT NULL,
    utc_ms INTEGER NOT NULL
);
INSERT INTO "state" VALUES('wanted','{"X": false, "Y": false, "Z": true}',1760000400000);
INSERT INTO "state" VALUES('alive_utc_s','1760000460.0',1760000400000);
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
INSERT INTO "temperature_cycles" VALUES(1,2,1760000410000,1010000,1,1500,1,NULL,X'900C9A0CA40C',NULL);
INSERT INTO "temperature_cycles" VALUES(2,3,1760000410000,1010000,1,1500,1,NULL,X'900C9A0C',NULL);
INSERT INTO "temperature_cycles" VALUES(3,2,1760000420000,1020000,2,1500,1,NULL,X'A00CAA0CB40C',NULL);
INSERT INTO "temperature_cycles" VALUES(4,3,1760000420000,1020000,2,1500,1,NULL,X'A00CAA0C',NULL);
INSERT INTO "temperature_cycles" VALUES(5,2,1760000430000,1030000,3,1500,1,NULL,X'B00CBA0CC40C',NULL);
INSERT INTO "temperature_cycles" VALUES(6,3,1760000430000,1030000,3,1500,1,NULL,X'B00CBA0C',NULL);
INSERT INTO "temperature_cycles" VALUES(7,2,1760000440000,1040000,4,1500,1,NULL,X'C00CCA0CD40C',NULL);
INSERT INTO "temperature_cycles" VALUES(8,3,1760000440000,1040000,4,1500,1,NULL,X'C00CCA0C',NULL);
INSERT INTO "temperature_cycles" VALUES(9,2,1760000450000,1050000,5,1500,1,NULL,X'D00CDA0CE40C',NULL);
INSERT INTO "temperature_cycles" VALUES(10,3,1760000450000,1050000,5,1500,1,NULL,X'D00CDA0C',NULL);
INSERT INTO "temperature_cycles" VALUES(11,2,1760000460000,1060000,6,1500,1,NULL,X'E00CEA0CF40C',NULL);
INSERT INTO "temperature_cycles" VALUES(12,3,1760000460000,1060000,6,1500,1,NULL,X'E00CEA0C',NULL);
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
INSERT INTO "writes" VALUES(1,1760000410000,1010000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":0.625,"Z":-1.25}','{"X":0.0,"Y":0.5,"Z":-1.0}','[false,true,true]','["Z slew"]','{"500":1.0,"501":0.0,"502":0.0005,"503":-0.001,"101":1234.567,"504":6.0,"505":1.0}',1,1.0,'',NULL,'{"X":null,"Y":1.5,"Z":-2.25}',1502.0,0.0,400.0,800.0,1200.0,1600.0);
INSERT INTO "writes" VALUES(2,1760000420000,1020000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":1.25,"Z":-2.5}','{"X":0.0,"Y":1.0,"Z":-2.0}','[false,true,true]','["Z slew"]','{"500":2.0,"501":0.0,"502":0.001,"503":-0.002,"101":1234.567,"504":6.0,"505":2.0}',1,2.0,'',NULL,'{"X":null,"Y":1.5,"Z":-2.25}',1502.0,0.0,400.0,800.0,1200.0,1600.0);
INSERT INTO "writes" VALUES(3,1760000430000,1030000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":1.875,"Z":-3.75}','{"X":0.0,"Y":1.5,"Z":-3.0}','[false,true,true]','["Z slew"]','{"500":3.0,"501":0.0,"502":0.0015,"503":-0.003,"101":1234.567,"504":6.0,"505":3.0}',1,3.0,'',NULL,'{"X":null,"Y":1.5,"Z":-2.25}',1502.0,0.0,400.0,800.0,1200.0,1600.0);
INSERT INTO "writes" VALUES(4,1760000440000,1040000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":2.5,"Z":-5.0}','{"X":0.0,"Y":2.0,"Z":-4.0}','[false,true,true]','["Z slew"]','{"500":4.0,"501":0.0,"502":0.002,"503":-0.004,"101":1234.567,"504":6.0,"505":4.0}',1,4.0,'',NULL,'{"X":null,"Y":1.5,"Z":-2.25}',1502.0,0.0,400.0,800.0,1200.0,1600.0);
INSERT INTO "writes" VALUES(5,1760000450000,1050000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":3.125,"Z":-6.25}','{"X":0.0,"Y":2.5,"Z":-5.0}','[false,true,true]','["Z slew"]','{"500":5.0,"501":0.0,"502":0.0025,"503":-0.005,"101":1234.567,"504":6.0,"505":5.0}',1,5.0,'',NULL,'{"X":null,"Y":1.5,"Z":-2.25}',1502.0,0.0,400.0,800.0,1200.0,1600.0);
INSERT INTO "writes" VALUES(6,1760000460000,1060000,'estimate',NULL,'ACTIVE','following','{"X":0.0,"Y":3.75,"Z":-7.5}','{"X":0.0,"Y":3.0,"Z":-6.0}','[false,true,true]','["Z slew"]','{"500":6.0,"501":0.0,"502":0.003,"503":-0.006,"101":1234.567,"504":6.0,"505":6.0}',0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
CREATE INDEX temperature_cycles_by_time ON temperature_cycles (layout_id, utc_ms);
CREATE INDEX cnc_samples_by_time ON cnc_samples (utc_ms);
CREATE INDEX displacements_by_time ON displacements (utc_ms);
CREATE INDEX estimates_by_time ON estimates (utc_ms);
CREATE INDEX writes_by_time ON writes (utc_ms);
CREATE INDEX writes_unsettled ON writes (write_id) WHERE outcome = 0;
CREATE INDEX events_by_time ON events (utc_ms);
CREATE INDEX reference_points_by_time ON reference_points (utc_ms);
CREATE INDEX chunks_by_time ON chunks (kind, layout_id, start_ms);
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('writes',6);
COMMIT;
PRAGMA application_id=1414547540;
PRAGMA user_version=1;
