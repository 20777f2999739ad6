"""A short run of the fuzz of tests/benchmarks/bench_haas.py: nothing breaks, no value lands on another macro."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

BENCH = Path(__file__).parents[1] / "benchmarks/bench_haas.py"
KINDS = {"right", "late", "twice", "foreign", "cut", "bits", "tail", "request"}


def bench() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_haas", BENCH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", [1, 2])
async def test_disturbed_answers_never_land_on_another_macro(seed: int) -> None:
    state = await bench().fuzz(6000, seed)
    assert set(state.frames) == KINDS
    assert state.taken > 1000 and state.wrong == 0
