-- Machine positions of the axes that cnc.axis_positions names [mm].
ALTER TABLE cnc ADD COLUMN positions_mm jsonb;
