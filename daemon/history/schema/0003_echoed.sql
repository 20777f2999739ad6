-- Schema 3. When the guard had taken over what a cycle led to: from that cycle's last byte to the first poll that
-- showed the value applied in full, in the machine's time. NULL while it has not, or where a newer value came first.
ALTER TABLE writes ADD COLUMN echoed_after_ms REAL;
