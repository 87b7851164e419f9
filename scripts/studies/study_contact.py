"""Contact compared with Hertz: a sphere and a long cylinder press a block; twins of an indentation.

    python scripts study_contact
    python scripts study_contact --parts poked --twins 20

The meshes have more and more elements per half-width of the contact. The computed force is compared
with the force that Hertz's theory gives for the computed width of the contact, from the second
moment of the pressures; this ratio does not depend on the size of the block. For `poked`, a hundred
twins of problems/poked_block, each with its own noise and onsets of contact, are identified with
finite elements and with Hertz's formula from the same forces.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import make_poked_block as gel
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.stats import sem
from scipy.stats import t as student
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.recording.obstacle_solids import Solid
from collocation_sysid.statistics.pose_noise import uncertainty_at

# True constants of the block.
YOUNG_PA = 1e4
POISSON = 0.3
LAW = {
    "lambda_pa": YOUNG_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)),
    "mu_pa": YOUNG_PA / (2 * (1 + POISSON)),
    "gamma_r_s": 0.01,
    "gamma_m_1_s": 1.0,
}
# Plane-strain modulus E/(1 − ν²) [Pa], of Hertz's formulas.
CONTACT_PA = YOUNG_PA / (1 - POISSON**2)
# Radius of the obstacles, in half-widths of the contact (1 m): so large that strains are small.
RADIUS_M = 50.0
# Extent of the fine part of the mesh, in half-widths of the contact.
FINE_M = 1.4
UP = np.array([0.0, 0.0, 1.0])
# Edges of the two blocks from which the force on a half-space is extrapolated.
SIZES_M = (30.0, 90.0)


def ticks(cells: int, fine_m: float, size_m: float, growth: float) -> np.ndarray:
    """Return coordinates of nodes: equal cells up to `fine_m`, then growing cells up to `size_m`
    [m].
    """
    coordinates_m = list(np.linspace(0, fine_m, cells + 1))
    step = fine_m / cells
    while coordinates_m[-1] < size_m:
        step *= growth
        coordinates_m.append(coordinates_m[-1] + step)
    outer_m = np.array(coordinates_m[cells:])
    outer_m = fine_m + (outer_m - fine_m) * (size_m - fine_m) / (outer_m[-1] - fine_m)
    return np.concatenate([coordinates_m[:cells], outer_m])


def graded_block(*edges: np.ndarray) -> cs.Body:
    """Return the block whose mesh has these coordinates (ascending) along x, y and z [m]."""
    return cs.Body(gel.graded(*edges), density_kg_m3=1.0, element="tet10")


def press(
    body: cs.Body, shape: Solid, depth_m: float, edge_m: float, *, is_stiff: bool = True
) -> tuple[float, float]:
    """Return the force [N], and the mean square distance of the pressure from the contact centre
    [m²], of an obstacle that moves by `depth_m` into a quarter of a block.

    If `is_stiff`, the contact stiffness is 100 E over the edge of the elements at the contact, and the
    width of the smooth onset of pressure 0.002 edges; otherwise both are the defaults.
    """
    low = body.nodes_m.min(axis=0)
    symmetry_nodes = [np.flatnonzero(np.abs(body.nodes_m[:, k] - low[k]) < 1e-9) for k in range(3)]
    fixed = cs.PoseSequence.fixed()
    sliding = [
        cs.Grasp(symmetry_nodes[0], fixed, axes="x"),
        cs.Grasp(symmetry_nodes[1], fixed, axes="y"),
        cs.Grasp(symmetry_nodes[2], fixed, axes="z"),
    ]
    if np.ptp(body.nodes_m[:, 1]) < 10:
        # A slice of a long block.
        far_nodes = np.abs(body.nodes_m[:, 1] - body.nodes_m[:, 1].max()) < 1e-9
        sliding.append(cs.Grasp(np.flatnonzero(far_nodes), fixed, axes="y"))
    down = cs.PoseSequence(
        np.arange(2.0), np.tile(-depth_m * UP, (2, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    )
    top = cs.Box((-1.0, -1.0, -1e-9), (3.0, 3.0, 1e-9))
    obstacle = cs.Obstacle(
        poses=down,
        shape=shape,
        faces=top if is_stiff else None,
        stiffness_pa_m=100 * YOUNG_PA / edge_m if is_stiff else None,
        width_m=0.002 * edge_m if is_stiff else None,
        wrench=cs.Wrench(np.zeros(1), np.zeros((1, 6)), 1.0, sigma_nm=1.0),
    )
    experiment = cs.Experiment(
        body,
        np.zeros(1),
        [*sliding, obstacle],
        kind="static",
        gravity_m_s2=np.zeros(3),
        air_density_kg_m3=0.0,
        nuisance=cs.Nuisance.none(),
    )
    equilibrium = cs.simulate(experiment, LAW)
    (term,) = contact_terms(experiment)
    x = equilibrium.positions_m.reshape(1, -1)
    points = term.points.vectors(x)[:, 0]
    gap_m = term.law_of_contact.gap_function.evaluate(
        points[:, None], np.zeros((0, 1, points.shape[1]))
    )[0, 0]
    law = term.law_of_contact
    approach_m = np.maximum(law.widths_m - gap_m, 0)
    penetration_m = np.maximum(-gap_m, 0)
    forces_n = law.surface.area_m2 * law.data[3] * (approach_m**2 - penetration_m**2) / law.widths_m
    x_m, y_m, _ = points[:3] + term.law_of_contact.body.frame_nodes_m[0][:, None]
    r2_m2 = x_m**2 + (y_m**2 if isinstance(shape, cs.Sphere) else 0.0)
    return -float(equilibrium.wrenches[0][0, 2]), float((forces_n * r2_m2).sum() / forces_n.sum())


def sphere(cells: float) -> tuple[float, int]:
    """Return the force over that of Hertz for the same contact radius, and the number of nodes.

    `cells` is the number of elements per contact radius.
    """
    across_m = ticks(round(FINE_M * cells), FINE_M, 30.0, 3.0)
    downward_m = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, 30.0, 3.0)
    body = graded_block(across_m, across_m, -downward_m)
    shape = cs.Sphere(RADIUS_M, RADIUS_M * UP)
    force_n, r2_m2 = press(body, shape, 1 / RADIUS_M, 1 / cells)
    # The mean of r² under √(1 − r²/a²) is 2a²/5; a quarter of the sphere is there.
    radius_m = np.sqrt(2.5 * r2_m2)
    return 4 * force_n / (4 / 3 * CONTACT_PA * radius_m**3 / RADIUS_M), len(body.nodes_m)


def sphere_at_depth(cells: int, size_m: float) -> float:
    """Return the force of a sphere over that of Hertz for its depth.

    Stiffness, width and faces of the contact are the defaults. A block of finite size is stiffer
    than a half-space, by a share that is inversely proportional to its size.
    """
    across_m = ticks(round(FINE_M * cells), FINE_M, size_m, 2.0)
    downward_m = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, size_m, 2.0)
    body = graded_block(across_m, across_m, -downward_m)
    shape = cs.Sphere(RADIUS_M, RADIUS_M * UP)
    depth_m = 1 / RADIUS_M
    force_n, _ = press(body, shape, depth_m, 1 / cells, is_stiff=False)
    hertz_n = 4 / 3 * CONTACT_PA * np.sqrt(RADIUS_M) * depth_m**1.5
    return 4 * force_n / hertz_n


def sphere_on_half_space(cells: int) -> float:
    """Return the force at a depth over that of Hertz, extrapolated from two blocks to a half-space,
    with the default contact and so many elements to the radius of the contact.
    """
    small, large = (sphere_at_depth(cells, size_m) for size_m in SIZES_M)
    ratio = SIZES_M[1] / SIZES_M[0]
    return (ratio * large - small) / (ratio - 1)


def cylinder(cells: float) -> tuple[float, int]:
    """Return force ratio and number of nodes, as `sphere` does, for half of a long cylinder."""
    edge_m = 1 / cells
    across_m = ticks(round(FINE_M * cells), FINE_M, 30.0, 2.0)
    downward_m = ticks(max(1, round(FINE_M * cells / 2)), FINE_M / 2, 30.0, 2.0)
    body = graded_block(across_m, np.array([0.0, edge_m]), -downward_m)
    ends = np.array([(0.0, -5.0, RADIUS_M), (0.0, 5.0, RADIUS_M)])
    # At this depth the half-width is about 1 m, although the block also deforms as a whole.
    shape = cs.Cylinder(RADIUS_M, ends)
    force_n, x2_m2 = press(body, shape, 2.1 / RADIUS_M, edge_m)
    # b² = 4 F R / (π E* L), and the mean of x² is b²/4.
    length_force = np.pi * CONTACT_PA * x2_m2 / RADIUS_M
    return 2 * force_n / edge_m / length_force, len(body.nodes_m)


@dataclass(frozen=True)
class IndentationEstimates:
    """Young's modulus of one twin with its interval, by finite elements and by Hertz's formula."""

    # (3,): E, and the lower and upper end of its 95 % interval [Pa].
    model_pa: np.ndarray
    hertz_pa: np.ndarray


def hertz_pa(depths_m: np.ndarray, force_n: np.ndarray) -> float:
    """Return E of F = 4/3 E/(1 − ν²) √R d^1.5, with the onset of the depth d fitted too [Pa]."""
    radius_m = 0.0032
    poisson = gel.TRUTH["poisson"]

    def residuals(unknown: np.ndarray) -> np.ndarray:
        indentation_m = np.maximum(depths_m - 1e-3 * unknown[1], 0)
        stiffness_n_m15 = 4 / 3 * 1e4 * unknown[0] / (1 - poisson**2) * np.sqrt(radius_m)
        return (stiffness_n_m15 * indentation_m**1.5 - force_n) / gel.NOISE_N

    return 1e4 * float(least_squares(residuals, [1.0, 0.0]).x[0])


def twins(count: int) -> Iterator[IndentationEstimates]:
    """Yield the results of twins of the shipped problem; each solve starts from the previous
    answer.
    """
    guess = f"parameters.young_pa.guess={gel.TRUTH['young_pa']}"
    problem = cs.Problem.read(gel.FOLDER / "problem.toml", [guess])
    table_depths_m = np.arange(-5e-4, 2.5e-3, 2e-5)
    exact_n = CubicSpline(table_depths_m, gel.forces_n(problem.experiments[0], table_depths_m))
    spread = student.ppf(0.975, gel.PLACES - 1)
    z = None
    for seed in range(count):
        rng = np.random.default_rng(seed)
        onset_m = gel.ONSET_M * rng.normal(size=gel.PLACES)
        force_n = exact_n(gel.DEPTHS_M - onset_m[:, None])
        force_n += gel.NOISE_N * rng.normal(size=force_n.shape)
        measured_experiments = []
        for experiment, own_n in zip(problem.experiments, force_n, strict=True):
            *grasps, tip = experiment.grasps
            assert tip.wrench is not None
            values = np.full(tip.wrench.values.shape, np.nan)
            values[:, 2] = -own_n / gel.QUARTERS
            measured_tip = replace(tip, wrench=replace(tip.wrench, values=values))
            measured_experiments.append(replace(experiment, grasps=[*grasps, measured_tip]))
        twin = replace(problem, experiments=measured_experiments).collocation()
        solution = ReducedSpace()(twin, start=z)
        z = solution.z
        uncertainty = uncertainty_at(solution.collocation, solution.z)
        hertz_estimates_pa = np.array([hertz_pa(gel.DEPTHS_M, own_n) for own_n in force_n])
        hertz_interval_pa = spread * sem(hertz_estimates_pa) * np.array([0, -1, 1])
        estimate = uncertainty.estimates["young_pa"]
        assert estimate.statistical95 is not None
        yield IndentationEstimates(
            np.array([estimate.value, *estimate.statistical95]),
            hertz_estimates_pa.mean() + hertz_interval_pa,
        )


def print_coverage(count: int = 100) -> None:
    """Print the coverage of the intervals of E, and the errors of the estimates."""
    estimates = list(twins(count))
    for name in ("model_pa", "hertz_pa"):
        value, low, high = (
            np.array([getattr(each, name) for each in estimates]).T / gel.TRUTH["young_pa"]
        )
        covered = int(((low < 1) & (high > 1)).sum())
        print(
            name.removesuffix("_pa"),
            f"{covered} of {count} intervals contain the true E; "
            f"E over its true value {value.mean():.4f} ± {value.std(ddof=1):.4f}",
        )
        print(f"  mean half-width of an interval over the true E {np.mean(high - low) / 2:.4f}")


def print_force_ratios(name: str) -> None:
    """Print the ratio of the computed force to Hertz's on finer and finer meshes."""
    law, resolutions = {
        "sphere": (sphere, (1.5, 3.0, 4.2)),
        "cylinder": (cylinder, (2.0, 4.0, 8.0)),
    }[name]
    for cells in resolutions:
        print(name, cells, law(cells), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parts = ("sphere", "cylinder", "poked")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--twins", type=int, default=100, help="of `poked`")
    arguments = parser.parse_args()
    for part in arguments.parts:
        if part == "poked":
            print_coverage(arguments.twins)
        else:
            print_force_ratios(part)


if __name__ == "__main__":
    main()
