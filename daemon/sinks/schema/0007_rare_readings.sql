-- The estimate that was in force when a probe was accepted is as old as the readings are rare: some come every five minutes.
CREATE OR REPLACE VIEW model_errors AS
    SELECT p.machine, date_trunc('month', p.time AT TIME ZONE 'UTC') AS month, p.axis, e.model_id, count(*) AS probes,
           sqrt(avg(p.deviation_um ^ 2)) AS with_um,
           sqrt(avg((p.deviation_um + p.thermal_error_um) ^ 2)) AS without_um
    FROM probes AS p
    CROSS JOIN LATERAL (
        SELECT model_id FROM estimates
        WHERE machine = p.machine AND time <= p.time AND time > p.time - interval '1 hour'
        ORDER BY time DESC LIMIT 1
    ) AS e
    WHERE p.accepted
    GROUP BY 1, 2, 3, 4;
