from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.mesh import TetMesh
from collocation_sysid.fem.meshing import box_mesh

BodyFactory = Callable[..., Body]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def small_mesh() -> TetMesh:
    """A box of 27 nodes and 48 elements, of which no two are alike."""
    box = box_mesh((0.10, 0.12, 0.09), (2, 2, 2))
    jitter = np.random.default_rng(1).uniform(-0.008, 0.008, box.points_m.shape)
    return TetMesh(box.points_m + jitter, box.tetrahedra)


@pytest.fixture(scope="session")
def make_body(small_mesh: TetMesh) -> BodyFactory:
    """``make_body(material, evaluator)`` on the small mesh; kernels are built once a session."""

    @cache
    def make(material: str = "neo-hookean", evaluator: str = "auto") -> Body:
        return Body(small_mesh, material, density_kg_m3=30.0, evaluator=evaluator)

    return make
