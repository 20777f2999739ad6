"""Short runs of the fuzzes of tests/benchmarks: nothing breaks, no value lands on another macro."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
KINDS = {"right", "late", "twice", "cut", "bits", "tail", "request"}


def bench(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("name", "own_kind", "frames"), [("bench_focas", "swapped", 3000), ("bench_haas", "foreign", 6000)]
)
async def test_disturbed_answers_never_land_on_another_macro(name: str, own_kind: str, frames: int, seed: int) -> None:
    state = await bench(name).fuzz(frames, seed)
    assert set(state.frames) == KINDS | {own_kind}
    assert state.taken > 1000 and state.wrong == 0
