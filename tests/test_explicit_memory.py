"""Memory as variables: derivatives of that program, and what methods find with it."""

from __future__ import annotations

import numpy as np
import pytest
from checks import assert_derivative
from memories_small import TWO, guesses, remembering

from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.explicit_memory import ExplicitMemory, with_explicit_memory

KINDS = {
    "relaxed": ("hung-cube", {}),
    "loaded": ("hung-cube", {"loaded_since_s": 0.04}),
    "undeformed": ("released-cube", {}),
    "let-go": ("bar-let-go", {}),
    "nuisance": ("bar-with-nuisance", {}),
}
LAYOUTS = [(kind, "midpoint") for kind in KINDS] + [
    ("loaded", "bdf2"),
    ("undeformed", "backward-euler"),
]


def explicit(collocation: Collocation) -> ExplicitMemory:
    found = with_explicit_memory(collocation)
    assert isinstance(found, ExplicitMemory)
    return found


def some_point(collocation: Collocation, rng: np.random.Generator) -> np.ndarray:
    """Variables that satisfy nothing."""
    positions = []
    for segment in collocation.segments:
        rigid = segment.experiment.rigid_positions(segment.dynamics.t_s).reshape(-1, segment.dofs)
        positions.append(rigid + 1e-3 * rng.normal(size=rigid.shape))
    p, nq = collocation.guess_p, collocation.nq
    p[:nq] += 0.1 * rng.normal(size=nq)
    p[nq:] = 0.5 * rng.normal(size=collocation.nphi)
    z = collocation.pack(p, positions)
    return z + 0.01 * rng.normal(size=len(z)) * (np.abs(z - collocation.pack(p, positions)) == 0)


def assert_derivatives(program: ExplicitMemory, rng: np.random.Generator) -> None:
    z, y = some_point(program, rng), rng.normal(size=program.constraints)

    def slope(at: np.ndarray) -> np.ndarray:
        return 1.3 * program.gradient(at) + program.jacobian(at).T @ y

    jacobian, hessian = program.jacobian(z), program.hessian(z, 1.3, y)
    of_m, of_q = np.zeros(len(z)), np.zeros(len(z))
    of_q[: program.nq] = 0.1
    for memory in program.memories.values():
        of_m[memory.variables] = 0.1
    for scale in (0.1, of_q, of_m):  # some columns would drown among the others
        values = program.constraint_values
        assert_derivative(values, lambda d: jacobian @ d, z, rng, scale=scale, directions=1)
        assert_derivative(slope, lambda d: hessian @ d, z, rng, scale=scale, directions=1)


@pytest.mark.parametrize(("kind", "scheme"), LAYOUTS, ids="-".join)
def test_derivatives(kind: str, scheme: str, rng):
    name, changes = KINDS[kind]
    collocation = Collocation([remembering(name, 4, 2, **changes)], guesses(TWO, 1.1), scheme)
    assert_derivatives(explicit(collocation), rng)
