-- A clock that was set back gives two readings of one sensor the same time: what was read keeps them apart.
ALTER TABLE displacements DROP CONSTRAINT IF EXISTS displacements_pkey;
CREATE UNIQUE INDEX displacements_key ON displacements (machine, time, source, md5(um::text));
-- When a plant's store last brought a row of the stream; `delivered` is when a sink of the machine itself did, where it has one.
ALTER TABLE deliveries ADD COLUMN stored timestamptz;
