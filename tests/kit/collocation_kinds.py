"""Collocations of a cube of twelve nodes with every kind of parameters, scheme, start and layout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment
from kit.problems import GUESS, hung_cube

DAMPING = GUESS.items[2:]


WITH_PRIOR = Parameters((replace(GUESS.items[0], prior=(300.0, 0.2)), *GUESS.items[1:]))


ENGINEERING = Parameters(
    (
        Parameter("young_pa", 700.0, 10.0, 1e5, prior=(600.0, 0.3)),
        Parameter("poisson", 0.2, 0.01, 0.49),
        *DAMPING,
    )
)


POISSON_FIXED = Parameters(
    (
        Parameter("young_pa", 700.0, 10.0, 1e5),
        Parameter("poisson", 0.2, is_fixed=True),
        Parameter("gamma_r_s", 0.0, is_fixed=True),
        DAMPING[1],
    )
)


ALL_FIXED = Parameters(tuple(Parameter(i.name, i.guess, is_fixed=True) for i in GUESS.items))


def swung(start: str = "equilibrium", steps: int = 5, **changes) -> Experiment:
    """A cube of twelve nodes; its tracks are random, some samples missing."""
    experiment = hung_cube(steps, (1, 1, 2), start="undeformed")
    if start == "given":
        rng = np.random.default_rng(8)
        shape = experiment.body.nodes_m.shape
        changes["start_positions_m"] = experiment.body.nodes_m + 1e-3 * rng.normal(size=shape)
        changes["start_velocities_m_s"] = 0.1 * rng.normal(size=shape)
    rng = np.random.default_rng(7)
    tracks = experiment.markers.predict_positions(experiment.rigid_positions(experiment.t_s))
    tracks += 5e-3 * rng.normal(size=tracks.shape)
    tracks[rng.random(tracks.shape[:2]) < 0.3] = np.nan
    return replace(with_markers(experiment, tracks), start=start, **changes)


# Every scheme from every start, and every other pair of choices at least once.
LAYOUTS = [
    (scheme, start, explicit == "rows", substeps)
    for scheme, row in zip(
        SCHEMES,
        (
            (("bounds", 2), ("rows", 2), ("bounds", 1)),
            (("rows", 1), ("bounds", 2), ("rows", 2)),
            (("bounds", 2), ("rows", 1), ("bounds", 2)),
        ),
        strict=True,
    )
    for start, (explicit, substeps) in zip(("equilibrium", "undeformed", "given"), row, strict=True)
]
