-- The newest estimate of a machine, of any line: the dashboard asks for it every ten seconds, model_errors once per probe.
CREATE INDEX estimates_time ON estimates (machine, time);
