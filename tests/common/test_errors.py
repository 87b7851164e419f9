"""Exceptions keep their messages when they are pickled."""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.program.forward.newton_solver import NewtonFailure

EXCEPTIONS = [
    SimulationError("a step failed", 0.03, 17),
    SimulationError("a step failed", 0.03),
    InputError("found 3; expected 4", Path("problem.toml"), "object.mesh"),
    InputError("found 3; expected 4"),
    NewtonFailure(np.arange(3.0), "no step makes progress"),
]


def fail(with_index: int) -> None:
    raise EXCEPTIONS[with_index]


def content(error: Exception) -> dict[str, object]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(error).items()}


@pytest.mark.parametrize("error", EXCEPTIONS, ids=lambda e: type(e).__name__)
def test_an_exception_survives_pickling_with_its_attributes(error: Exception):
    twin = pickle.loads(pickle.dumps(error))
    assert type(twin) is type(error)
    assert str(twin) == str(error)
    assert content(twin) == content(error)


@pytest.mark.long
def test_a_process_pool_hands_exceptions_on():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        for k, error in enumerate(EXCEPTIONS):
            with pytest.raises(type(error)) as caught:
                pool.submit(fail, k).result(timeout=60)
            assert str(caught.value) == str(error)
            assert content(caught.value) == content(error)
        assert pool.submit(abs, -1).result(timeout=60) == 1  # the pool is alive
