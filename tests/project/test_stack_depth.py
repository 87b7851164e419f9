"""Functions between `run` and a compiled kernel do more than call the next one.

Frames of the package on the call stack are counted whenever a compiled kernel is called, from `run`
to the call, in a complete identification from a guess: search, verification and uncertainties. The
limit is the number that has been reached; lower it with each function that is removed from the
path. The aim is 15.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from kit.problems import TRUTH, hung_cube, measured

import collocation_sysid as cs
from collocation_sysid.fem.kernels import choose_evaluator, run_in_slices, simd

PACKAGE = str(Path(cs.__file__).parent)
# Largest number of frames.
LIMIT = 21


def package_frames(frame: FrameType | None) -> list[str]:
    """Return file and function of the frames of the package, `run` first."""
    names = []
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(PACKAGE):
            file = Path(code.co_filename).relative_to(PACKAGE)
            names.append(f"{file}: {code.co_qualname}")
        frame = frame.f_back
    return names[::-1]


@pytest.mark.skipif(
    choose_evaluator() != "simd", reason="kernels are evaluated by CasADi"
)
def test_few_frames_lead_from_run_to_a_compiled_kernel(monkeypatch):
    stacks = []

    def recorded(*arguments: Any, **options: Any) -> None:
        own = "fem/kernels/threads.py: run_in_slices"
        stacks.append([*package_frames(sys._getframe()), own])
        run_in_slices(*arguments, **options)

    cube = measured(hung_cube(steps=4, divisions=(1, 1, 1)))
    guessed = TRUTH | {"mu_pa": cs.Unknown(200.0)}
    problem = cs.Problem([cube], guessed, substeps=1)
    monkeypatch.setattr(simd, "run_in_slices", recorded)
    run = cs.run(problem, seek_causes=False)
    assert run.solution.status.converged
    deepest = max(stacks, key=len)
    assert deepest[0] == "pipeline.py: run"
    assert len(deepest) <= LIMIT, "\n".join(deepest)
