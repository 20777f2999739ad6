-- Schema 6. Machine positions of the axes that cnc.axis_positions names, as JSON [mm]; NULL where none are read.
ALTER TABLE cnc_samples ADD COLUMN positions_mm TEXT;
