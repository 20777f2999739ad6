-- What probes found of each model, month by month (UTC). without_um: what the estimate took away is added again, as if the
-- output had followed all of it; `toolpoint model drift` on the machine knows what was applied.
CREATE VIEW model_errors AS
    SELECT p.machine, date_trunc('month', p.time AT TIME ZONE 'UTC') AS month, p.axis, e.model_id, count(*) AS probes,
           sqrt(avg(p.deviation_um ^ 2)) AS with_um,
           sqrt(avg((p.deviation_um + p.thermal_error_um) ^ 2)) AS without_um
    FROM probes AS p
    CROSS JOIN LATERAL (
        SELECT model_id FROM estimates
        WHERE machine = p.machine AND time <= p.time AND time > p.time - interval '1 minute'
        ORDER BY time DESC LIMIT 1
    ) AS e
    WHERE p.accepted
    GROUP BY 1, 2, 3, 4;
