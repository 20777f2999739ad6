"""Many reports: the first at once, the rest summed up, none without a trace."""

from daemon.rate_limit import RateLimit


async def test_the_first_pass_at_once_and_the_rest_is_counted() -> None:
    said: list[tuple[int, int]] = []
    limit = RateLimit[int](lambda item, left_out: said.append((item, left_out)), burst=3, period_s=3600.0)
    for number in range(10):
        limit(number)
    assert said == [(0, 0), (1, 0), (2, 0)]
    limit.flush()
    assert said[3:] == [(9, 6)]
    limit(10)
    assert said[4:] == [(10, 0)], "a flush begins anew"
    assert sum(1 + left_out for _, left_out in said) == 11
