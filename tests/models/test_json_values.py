"""Values as JSON carries them."""

import json

import numpy as np
import pytest

from models.json_values import finite_or_none, plain


def test_numbers_become_plain() -> None:
    given = {1: np.float64("nan"), "a": [np.int64(3), np.bool_(True), np.inf], "b": (None, "x", 2.5)}
    assert plain(given) == {"1": None, "a": [3, True, None], "b": [None, "x", 2.5]}
    assert plain({"table": np.array([[1.0, np.nan]])}) == {"table": [[1.0, None]]}
    assert type(plain(np.float64(2.5))) is float
    json.dumps(plain(given), allow_nan=False)


@pytest.mark.parametrize("value", [None, float("nan"), float("inf"), -float("inf"), np.float64("nan")])
def test_what_is_no_number_is_none(value: float | None) -> None:
    assert finite_or_none(value) is None
    assert finite_or_none(value, 2) is None


def test_decimals_round_and_without_them_nothing_is_lost() -> None:
    assert finite_or_none(1.0 / 3.0) == 1.0 / 3.0
    assert finite_or_none(np.float64(1.23456), 2) == 1.23
