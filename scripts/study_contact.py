"""Contact against Hertz: a sphere and a long cylinder that press a block.

    python scripts/study_contact.py [sphere] [cylinder]

Meshes have ever more elements to the half-width of the contact. What is compared is the force with
that which Hertz has for the width that is found, from the second moment of the pressures: neither
depends on how far away the block ends.
"""

from __future__ import annotations

import sys

import numpy as np

import collocation_sysid as cs
from collocation_sysid.model.contact import contacts
from collocation_sysid.recording.solids import Solid

YOUNG_PA, POISSON = 1e4, 0.3
LAW = {
    "lambda_pa": YOUNG_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)),
    "mu_pa": YOUNG_PA / (2 * (1 + POISSON)),
    "gamma_r_s": 0.01,
    "gamma_m_1_s": 1.0,
}
CONTACT_PA = YOUNG_PA / (1 - POISSON**2)
# Lengths in half-widths of the contact: a fiftieth of the radius strains little.
RADIUS_M, FINE_M = 50.0, 1.4
UP = np.array([0.0, 0.0, 1.0])


def ticks(cells: int, fine_m: float, size_m: float, growth: float) -> np.ndarray:
    """So many equal cells to `fine_m`, then ever larger ones to `size_m`."""
    found, step = list(np.linspace(0, fine_m, cells + 1)), fine_m / cells
    while found[-1] < size_m:
        step *= growth
        found.append(found[-1] + step)
    outer = np.array(found[cells:])
    outer = fine_m + (outer - fine_m) * (size_m - fine_m) / (outer[-1] - fine_m)
    return np.concatenate([found[:cells], outer])


def block(*edges: np.ndarray) -> cs.Body:
    """Between these places along x, y and z."""
    cells = [len(each) - 1 for each in edges]
    even = cs.box_mesh((1.0,) * 3, cells)
    places = [
        np.interp(even.points_m[:, k], np.linspace(0, 1, len(each)), each)
        for k, each in enumerate(edges)
    ]
    mesh = cs.TetMesh(np.column_stack(places), even.tetrahedra)
    return cs.Body(mesh, density_kg_m3=1.0, element="tet10")


def pressed(
    body: cs.Body, shape: Solid, depth_m: float, edge_m: float, kappa: float, delta: float
) -> tuple[float, float]:
    """The force [N], and the mean square of the distances from the middle of the contact [m²]."""
    low = body.nodes_m.min(axis=0)
    where = [np.flatnonzero(np.abs(body.nodes_m[:, k] - low[k]) < 1e-9) for k in range(3)]
    fixed = cs.PoseSequence.fixed()
    sliding = [
        cs.Grasp(where[0], fixed, axes="x"),
        cs.Grasp(where[1], fixed, axes="y"),
        cs.Grasp(where[2], fixed, axes="z"),
    ]
    if np.ptp(body.nodes_m[:, 1]) < 10:
        # A slice of a long block.
        far = np.abs(body.nodes_m[:, 1] - body.nodes_m[:, 1].max()) < 1e-9
        sliding.append(cs.Grasp(np.flatnonzero(far), fixed, axes="y"))
    down = cs.PoseSequence(
        np.arange(2.0), np.tile(-depth_m * UP, (2, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    )
    top = cs.Box((-1.0, -1.0, -1e-9), (3.0, 3.0, 1e-9))
    touched = cs.Obstacle(
        poses=down,
        shape=shape,
        faces=top,
        stiffness_pa_m=kappa * YOUNG_PA / edge_m,
        width_m=delta * edge_m,
        wrench=cs.Wrench(np.zeros(1), np.zeros((1, 6)), 1.0, sigma_nm=1.0),
    )
    experiment = cs.Experiment(
        body,
        np.zeros(1),
        [*sliding, touched],
        kind="static",
        gravity_m_s2=np.zeros(3),
        nuisance=cs.Nuisance.none(),
    )
    seen = cs.simulate(experiment, LAW)
    (term,) = contacts(experiment, 1)
    x = seen.positions_m.reshape(1, -1)
    place = term.points.vectors(x)[:, 0]
    gap_m = term.contact.distance.value(place[:, None], np.zeros((0, 1, place.shape[1])))[0, 0]
    push = term.contact.surface.area_m2 * np.maximum(term.contact.width_m - gap_m, 0) ** 2
    x_m, y_m, _ = place[:3] + term.contact.body.frame_m[0][:, None]
    r2_m2 = x_m**2 + (y_m**2 if isinstance(shape, cs.Sphere) else 0.0)
    return -float(seen.wrenches[0][0, 2]), float((push * r2_m2).sum() / push.sum())


def sphere(cells: float, kappa: float = 100.0, delta: float = 0.002) -> tuple[float, int]:
    """Force over Hertz' for its radius, and nodes, at so many elements to the radius."""
    edge_m = 1 / cells
    wide = ticks(round(FINE_M * cells), FINE_M, 30.0, 3.0)
    deep = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, 30.0, 3.0)
    body = block(wide, wide, -deep)
    shape = cs.Sphere(RADIUS_M, RADIUS_M * UP)
    force_n, r2_m2 = pressed(body, shape, 1 / RADIUS_M, edge_m, kappa, delta)
    # The mean of r² under √(1 − r²/a²) is 2a²/5; a quarter of the sphere is there.
    radius_m = np.sqrt(2.5 * r2_m2)
    return 4 * force_n / (4 / 3 * CONTACT_PA * radius_m**3 / RADIUS_M), len(body.nodes_m)


def cylinder(cells: float, kappa: float = 100.0, delta: float = 0.002) -> tuple[float, int]:
    """The same of a long cylinder, of which half is there."""
    edge_m = 1 / cells
    wide = ticks(round(FINE_M * cells), FINE_M, 30.0, 2.0)
    deep = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, 30.0, 2.0)
    body = block(wide, np.array([0.0, edge_m]), -deep)
    ends = np.array([(0.0, -5.0, RADIUS_M), (0.0, 5.0, RADIUS_M)])
    # So deep that the half-width is about one; the block gives as a whole, too.
    shape = cs.Cylinder(RADIUS_M, ends)
    force_n, x2_m2 = pressed(body, shape, 2.1 / RADIUS_M, edge_m, kappa, delta)
    # b² = 4 F R / (π E* L), and the mean of x² is b²/4.
    length_force = np.pi * CONTACT_PA * x2_m2 / RADIUS_M
    return 2 * force_n / edge_m / length_force, len(body.nodes_m)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        law = {"sphere": sphere, "cylinder": cylinder}[name]
        for cells in (1.5, 3.0) if name == "sphere" else (2.0, 4.0, 8.0):
            print(name, cells, law(cells), flush=True)
        if name == "cylinder":
            for kappa, delta in ((10, 0.02), (30, 0.002), (100, 0.02), (300, 0.002), (1000, 2e-4)):
                print(name, 8.0, kappa, delta, law(8.0, kappa, delta), flush=True)
