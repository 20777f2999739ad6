"""Searches of a Gaussian process's hyper-parameters, each made once per process: tests train on the same rows again.

A search is a function of its rows, of where it begins and of its number of steps, and of nothing else, so what is
found is what it would find again, to the bit. Tests that ask whether it does are not to use this.
"""

import contextlib
import hashlib
from collections.abc import Iterator
from unittest.mock import patch

import numpy as np

from models.records import FloatArray
from models.thermal.features import IntArray
from models.thermal.training.gaussian_process import GaussianProcess

_found: dict[bytes, FloatArray] = {}


@contextlib.contextmanager
def searched_once() -> Iterator[None]:
    """Let a search that was made in this process answer with what it found."""
    search = GaussianProcess.likely

    def likely(process: GaussianProcess, used: IntArray, begin: FloatArray, steps: int) -> FloatArray:
        rows, digest = process.rows, hashlib.sha256(f"{steps} {len(process.rows.groups)}".encode())
        arrays = (rows.columns, *rows.groups, rows.coordinates, rows.run, rows.time_min, rows.values, used, begin)
        for array in arrays:
            digest.update(
                f"{array.shape} {array.dtype} {array.strides}".encode() + np.ascontiguousarray(array).tobytes()
            )
        key = digest.digest()
        if key not in _found:
            _found[key] = search(process, used, begin, steps)
        return _found[key].copy()

    with patch.object(GaussianProcess, "likely", likely):
        yield
