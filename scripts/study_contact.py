"""Contact against Hertz: a sphere and a long cylinder that press a block; and twins of a poked one.

    python scripts/study_contact.py [sphere] [cylinder] [poked]

Meshes have ever more elements to the half-width of the contact. What is compared is the force with
that which Hertz has for the width that is found, from the second moment of the pressures: neither
depends on how far away the block ends. Of problems/poked_block a hundred twins are solved, each
with noise and beginnings of contact of its own, and so is Hertz' formula with the same forces.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import make_poked_block as gel
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.stats import sem
from scipy.stats import t as student

import collocation_sysid as cs
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.contact.contact_force import contact_terms
from collocation_sysid.recording.obstacle_solids import Solid
from collocation_sysid.statistics.uncertainty import uncertainty_at

YOUNG_PA = 1e4
POISSON = 0.3
LAW = {
    "lambda_pa": YOUNG_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)),
    "mu_pa": YOUNG_PA / (2 * (1 + POISSON)),
    "gamma_r_s": 0.01,
    "gamma_m_1_s": 1.0,
}
CONTACT_PA = YOUNG_PA / (1 - POISSON**2)
# Lengths in half-widths of the contact: a fiftieth of the radius strains little.
RADIUS_M = 50.0
FINE_M = 1.4
UP = np.array([0.0, 0.0, 1.0])
# Blocks from which the force on a half-space is extrapolated.
SIZES_M = (30.0, 90.0)


def ticks(
    cells: int, fine_m: float, size_m: float, growth: float
) -> np.ndarray:
    """Return coordinates of nodes: equal cells up to `fine_m`, then growing cells up to `size_m` [m]."""
    found = list(np.linspace(0, fine_m, cells + 1))
    step = fine_m / cells
    while found[-1] < size_m:
        step *= growth
        found.append(found[-1] + step)
    outer = np.array(found[cells:])
    outer = fine_m + (outer - fine_m) * (size_m - fine_m) / (outer[-1] - fine_m)
    return np.concatenate([found[:cells], outer])


def block(*edges: np.ndarray) -> cs.Body:
    """Between these places along x, y and z."""
    return cs.Body(gel.graded(*edges), density_kg_m3=1.0, element="tet10")


def pressed(
    body: cs.Body,
    shape: Solid,
    depth_m: float,
    edge_m: float,
    kappa: float | None,
    delta: float | None,
) -> tuple[float, float]:
    """The force [N], and the mean square of the distances from the middle of the contact [m²].

    Where κ or δ is None, the obstacle has the default, and may touch all faces.
    """
    low = body.nodes_m.min(axis=0)
    where = [
        np.flatnonzero(np.abs(body.nodes_m[:, k] - low[k]) < 1e-9)
        for k in range(3)
    ]
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
        np.arange(2.0),
        np.tile(-depth_m * UP, (2, 1)),
        np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
    )
    top = cs.Box((-1.0, -1.0, -1e-9), (3.0, 3.0, 1e-9))
    touched = cs.Obstacle(
        poses=down,
        shape=shape,
        faces=None if kappa is None else top,
        stiffness_pa_m=None if kappa is None else kappa * YOUNG_PA / edge_m,
        width_m=None if delta is None else delta * edge_m,
        wrench=cs.Wrench(np.zeros(1), np.zeros((1, 6)), 1.0, sigma_nm=1.0),
    )
    experiment = cs.Experiment(
        body,
        np.zeros(1),
        [*sliding, touched],
        kind="static",
        gravity_m_s2=np.zeros(3),
        air_density_kg_m3=0.0,
        nuisance=cs.Nuisance.none(),
    )
    seen = cs.simulate(experiment, LAW)
    (term,) = contact_terms(experiment)
    x = seen.positions_m.reshape(1, -1)
    place = term.points.vectors(x)[:, 0]
    gap_m = term.law_of_contact.gap_function.evaluate(
        place[:, None], np.zeros((0, 1, place.shape[1]))
    )[0, 0]
    law = term.law_of_contact
    near = np.maximum(law.widths_m - gap_m, 0)
    within = np.maximum(-gap_m, 0)
    push = (
        law.surface.area_m2 * law.data[3] * (near**2 - within**2) / law.widths_m
    )
    x_m, y_m, _ = place[:3] + term.law_of_contact.body.frame_nodes_m[0][:, None]
    r2_m2 = x_m**2 + (y_m**2 if isinstance(shape, cs.Sphere) else 0.0)
    return -float(seen.wrenches[0][0, 2]), float(
        (push * r2_m2).sum() / push.sum()
    )


def sphere(
    cells: float, kappa: float = 100.0, delta: float = 0.002
) -> tuple[float, int]:
    """Force over Hertz' for its radius, and nodes, at so many elements to the radius."""
    edge_m = 1 / cells
    wide = ticks(round(FINE_M * cells), FINE_M, 30.0, 3.0)
    deep = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, 30.0, 3.0)
    body = block(wide, wide, -deep)
    shape = cs.Sphere(RADIUS_M, RADIUS_M * UP)
    force_n, r2_m2 = pressed(body, shape, 1 / RADIUS_M, edge_m, kappa, delta)
    # The mean of r² under √(1 − r²/a²) is 2a²/5; a quarter of the sphere is there.
    radius_m = np.sqrt(2.5 * r2_m2)
    return 4 * force_n / (4 / 3 * CONTACT_PA * radius_m**3 / RADIUS_M), len(
        body.nodes_m
    )


def sphere_at_depth(cells: int, size_m: float) -> tuple[float, int]:
    """Return the force of a sphere over that of Hertz for its depth, and the number of nodes.

    Stiffness, width and faces of the contact are the defaults. A block of finite size is stiffer
    than a half-space, by a share that is inversely proportional to its size.

    Parameters
    ----------
    cells : int
        Elements to the radius of the contact.
    size_m : float
        Edge of the block, in radii of the contact.
    """
    wide = ticks(round(FINE_M * cells), FINE_M, size_m, 2.0)
    deep = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, size_m, 2.0)
    body = block(wide, wide, -deep)
    shape = cs.Sphere(RADIUS_M, RADIUS_M * UP)
    depth_m = 1 / RADIUS_M
    force_n, _ = pressed(body, shape, depth_m, 1 / cells, None, None)
    hertz_n = 4 / 3 * CONTACT_PA * np.sqrt(RADIUS_M) * depth_m**1.5
    return 4 * force_n / hertz_n, len(body.nodes_m)


def sphere_on_half_space(cells: int) -> float:
    """Return the force at a depth over that of Hertz, extrapolated from two blocks to a half-space,
    with the default contact and so many elements to the radius of the contact.
    """
    small, large = (sphere_at_depth(cells, size_m)[0] for size_m in SIZES_M)
    ratio = SIZES_M[1] / SIZES_M[0]
    return (ratio * large - small) / (ratio - 1)


def cylinder(
    cells: float, kappa: float = 100.0, delta: float = 0.002
) -> tuple[float, int]:
    """Return force ratio and number of nodes, as `sphere` does, for half of a long cylinder."""
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


@dataclass(frozen=True)
class Twin:
    """Young's modulus of one twin with its interval, by finite elements and by Hertz's formula.

    Attributes
    ----------
    model_pa, hertz_pa : (3,)
        E, and where its 95 % interval begins and ends.
    places_held : int
        Beginnings of contact that are within two standard errors of the truth.
    """

    model_pa: np.ndarray
    hertz_pa: np.ndarray
    places_held: int


def hertz_pa(depths_m: np.ndarray, force_n: np.ndarray) -> float:
    """Return E of F = 4/3 E/(1 − ν²) √R d^1.5, with the onset of the depth d fitted too [Pa]."""
    radius_m = 0.0032
    poisson = gel.TRUTH["poisson"]

    def missed(unknown: np.ndarray) -> np.ndarray:
        deep_m = np.maximum(depths_m - 1e-3 * unknown[1], 0)
        stiff = 4 / 3 * 1e4 * unknown[0] / (1 - poisson**2) * np.sqrt(radius_m)
        return (stiff * deep_m**1.5 - force_n) / gel.NOISE_N

    return 1e4 * float(least_squares(missed, [1.0, 0.0]).x[0])


def twins(count: int) -> Iterator[Twin]:
    """Yield the results of twins of the shipped problem; each solve starts from the previous answer."""
    guess = f"parameters.young_pa.guess={gel.TRUTH['young_pa']}"
    problem = cs.Problem.read(gel.FOLDER / "problem.toml", [guess])
    reach_m = np.arange(-5e-4, 2.5e-3, 2e-5)
    exact_n = CubicSpline(
        reach_m, gel.forces_n(problem.experiments[0], reach_m)
    )
    spread = student.ppf(0.975, gel.PLACES - 1)
    z = None
    for seed in range(count):
        rng = np.random.default_rng(seed)
        onset_m = gel.ONSET_M * rng.normal(size=gel.PLACES)
        force_n = exact_n(gel.DEPTHS_M - onset_m[:, None])
        force_n += gel.NOISE_N * rng.normal(size=force_n.shape)
        measured = []
        for experiment, own_n in zip(problem.experiments, force_n, strict=True):
            *held, tip = experiment.grasps
            assert tip.wrench is not None
            values = np.full(tip.wrench.values.shape, np.nan)
            values[:, 2] = -own_n / gel.QUARTERS
            read = replace(tip, wrench=replace(tip.wrench, values=values))
            measured.append(replace(experiment, grasps=[*held, read]))
        twin = replace(problem, experiments=measured).collocation()
        solution = ReducedSpace()(twin, start=z)
        z = solution.z
        told = uncertainty_at(solution.collocation, solution.z)
        places = [
            part.phi[0] for part in solution.collocation.iterates(solution.z)
        ]
        off = np.abs(np.array(places) - onset_m / gel.ONSET_M) / list(
            told.nuisance.values()
        )
        simple = np.array([hertz_pa(gel.DEPTHS_M, own_n) for own_n in force_n])
        half = spread * sem(simple) * np.array([0, -1, 1])
        found = told.estimates["young_pa"]
        assert found.statistical95 is not None
        yield Twin(
            np.array([found.value, *found.statistical95]),
            simple.mean() + half,
            int(sum(off < 1.96)),
        )


def poked(count: int = 100) -> None:
    """Print how often the truth is in the intervals, and how far off estimates are."""
    found = list(twins(count))
    for name in ("model_pa", "hertz_pa"):
        value, low, high = (
            np.array([getattr(each, name) for each in found]).T
            / gel.TRUTH["young_pa"]
        )
        inside = int(((low < 1) & (high > 1)).sum())
        print(
            name,
            f"held by {inside} of {count}: {value.mean():.4f} ± {value.std(ddof=1):.4f}",
        )
        print(f"  half width of an interval {np.mean(high - low) / 2:.4f}")
    print(
        f"beginnings held: {sum(each.places_held for each in found)} of {count * gel.PLACES}"
    )


if __name__ == "__main__":
    if "poked" in sys.argv:
        poked()
        sys.argv.remove("poked")
    for name in sys.argv[1:]:
        law = {"sphere": sphere, "cylinder": cylinder}[name]
        for cells in (1.5, 3.0, 4.2) if name == "sphere" else (2.0, 4.0, 8.0):
            print(name, cells, law(cells), flush=True)
        if name == "cylinder":
            for kappa, delta in (
                (10, 0.02),
                (30, 0.002),
                (100, 0.02),
                (300, 0.002),
                (1000, 2e-4),
            ):
                print(
                    name, 8.0, kappa, delta, law(8.0, kappa, delta), flush=True
                )
