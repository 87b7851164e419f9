"""Bodies with several branches of memory, and collocations with lifted variables."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.regions import Region
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import LiftedCollocation, with_lifted_variables
from collocation_sysid.recording import Experiment
from kit.memories import ONE
from kit.problems import box, hung_cube, measured_with

CORE = Region("core", np.arange(6), prony=["slow"])


REGIONS = ONE | {"core.slow.share": 0.7, "core.slow.tau_s": 0.08}


@cache
def of_branches(count: int) -> Body:
    """A cube of twelve nodes."""
    names = [f"prony_{k + 1}" for k in range(count)]
    return Body(box(divisions=(1, 1, 2)).mesh, density_kg_m3=30.0, prony=names)


@cache
def of_regions() -> Body:
    """The same with a core that has a branch of its own."""
    mesh = box(divisions=(1, 1, 2)).mesh
    return Body(mesh, density_kg_m3=30.0, prony=["prony_1"], regions=[CORE])


def swung(body: Body, values: dict[str, float], steps: int, **changes) -> Experiment:
    """The hung cube with this body, and the tracks that these parameters give it."""
    experiment = replace(hung_cube(steps, (1, 1, 2)), body=body, **changes)
    return measured_with(experiment, values)


def explicit(collocation: Collocation) -> Collocation:
    found = with_lifted_variables(collocation)
    assert isinstance(found, LiftedCollocation)
    return found
