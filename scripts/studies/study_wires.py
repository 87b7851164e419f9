"""Bending stiffness of two wires from photographs of hanging loops, and their torsional stiffness.

The folder has the points of five photographs for each wire, black_0.csv to white_4.csv, with the
columns point, x_m and z_m. Each photograph is an equilibrium between two clamps whose directions
are unknown; the points are drawn along the wire, so that their places on it are unknown, too. The
scale of a photograph is that with which the smooth curve through its points is as long as the wire.
The natural curvature is constant in each of twenty parts of the wire, with a prior; it belongs to one
photograph, or to all of a wire. GJ/EI is that with which the loop leaves its plane at the measured
twist of one clamp.

    python scripts study_wires FOLDER
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Along
from collocation_sysid.kinds.rod.element import centres_of_sections
from collocation_sysid.result.figure_style import RESOLUTION_DPI

Array = NDArray[np.float64]
PHOTOGRAPHS = 5
LENGTH_M = 1.5
SECTIONS = 121
# Axial stiffness [N] of both wires: their weight of at most 0.4 N stretches them by less than 0.8 %,
# and half of it gives the same critical twist.
AXIAL_N = 50.0
# Diameter of the section [m], which only places its nodes: stiffnesses and mass are stated.
DIAMETER_M = 3e-3
# Standard deviations: of drawn points across the wire and along it [m], of the direction of a clamp
# [rad], of the scale of a photograph, and of the natural curvature of each part of the wire [1/m].
SIGMA_M = 1.5e-3
ALONG_M = 1e-2
CLAMP_RAD = 0.5
SCALE = 3e-3
CURVATURE_1_M = 2.0
PARTS = 20
# Ratios GJ/EI between which is interpolated, and twists [°].
RATIOS = (0.5, 0.7, 1.0, 1.4, 2.0)
TWIST_STEP_DEG = 10.0
LARGEST_TWIST_DEG = 1400.0
PICTURES = Path(__file__).parents[2] / "docs" / "pictures"


@dataclass(frozen=True)
class Wire:
    """A wire, and what its authors found."""

    name: str
    mass_per_length_kg_m: float
    bending_n_m2: float  # of the authors, mean of five shapes
    twist_deg: tuple[float, ...]  # critical twists of the loop, measured
    ratio: float  # GJ/EI of the authors


WIRES = (
    Wire("black", 27.2e-3, 1.20e-3, (470.0, 500.0, 480.0, 470.0, 490.0), 1.46),
    Wire("white", 17.4e-3, 1.22e-4, (970.0, 970.0, 980.0, 975.0, 980.0), 0.82),
)


def read_loop(file: Path) -> Array:
    """Return the points (k, 3) [m] of a photograph, in the plane y = 0, with the scale that makes the
    smooth curve through them as long as the wire.
    """
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    points_m = np.column_stack([table[:, 1], np.zeros(len(table)), table[:, 2]])
    curve = cs.rod_mesh(points_m, cs.CrossSection.round(DIAMETER_M))
    return points_m * LENGTH_M / curve.s_m[-1]


def hanging_wire(points_m: Array, mass_per_length_kg_m: float, parts: Sequence[str] = ()) -> Body:
    """Return a wire that is straight at rest, in the shape of points (k, 3), whose natural curvature
    is constant in each of some named parts; without parts it has none.
    """
    mesh = cs.rod_mesh(
        points_m,
        cs.CrossSection.round(DIAMETER_M),
        sections=SECTIONS,
        first_director=[0.0, 1.0, 0.0],
        is_straight_at_rest=True,
    )
    ends = 3 * np.linspace(0, len(mesh.s_m) - 1, len(parts) + 1).round().astype(int)
    cells = np.arange(len(mesh.tetrahedra))  # three of each element
    regions = [cs.Region(name, cells[ends[k] : ends[k + 1]]) for k, name in enumerate(parts)]
    mass_kg = mass_per_length_kg_m * float(mesh.s_m[-1])
    return Body(mesh, "cable", mass_kg=mass_kg, regions=regions, natural_curvature=bool(parts))


def photograph(body: Body, points_m: Array, name: str) -> cs.Experiment:
    """Return the equilibrium of a wire between clamps at the first and last of its drawn points.

    The body is in the shape of another photograph, from which the clamps have moved.
    """
    mesh = body.mesh
    assert isinstance(mesh, cs.RodMesh)
    length_m = float(mesh.s_m[-1])
    centres = mesh.centres_of_sections_m
    grasps = []
    for place_m, drawn, start in (
        (0.0, points_m[0], centres[0]),
        (length_m, points_m[-1], centres[-1]),
    ):
        pose = np.eye(4)[None]
        pose[0, :3, 3] = drawn - start
        grasps.append(cs.Grasp(Along(place_m, place_m), pose))
    drawn_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1)))
    along_m = np.minimum(drawn_m * length_m / drawn_m[-1], length_m)
    inner = slice(1, -1)
    seen_m = points_m[inner].copy()
    seen_m[:, 1] = np.nan  # a photograph has no depth
    markers = cs.Markers(
        [0.0],
        seen_m[None],
        SIGMA_M,
        places_m=np.array([mesh.place_m(s) for s in along_m[inner]]),
        places_sigma_m=ALONG_M,
    )
    nuisance = cs.Nuisance.none(
        clamp_turn_rad=CLAMP_RAD, gravity_rad=np.radians(1.0), calibration_scale=SCALE
    )
    return cs.Experiment(
        body,
        [0.0],
        grasps,
        markers,
        kind="static",
        name=name,
        nuisance=nuisance,
        air_density_kg_m3="none",
    )


def loops_problem(
    loops_m: Sequence[Array], mass_per_length_kg_m: float, guess_n_m2: float, parts: int = PARTS
) -> cs.Problem:
    """Return the identification of EI from loops (k, 3) [m] of one wire."""
    names = [f"part{k + 1}" for k in range(parts)]
    body = hanging_wire(loops_m[0], mass_per_length_kg_m, names)
    experiments = [photograph(body, loop, f"loop{k}") for k, loop in enumerate(loops_m)]
    parameters: dict[str, cs.Unknown | float] = {
        "bending_n_m2": cs.Unknown(guess_n_m2),
        # In a plane nothing depends on it.
        "torsion_n_m2": guess_n_m2,
        "axial_n": AXIAL_N,
        "gamma_r_s": 0.0,
        "gamma_m_1_s": 0.0,
    }
    for name in names:
        parameters[f"{name}.curvature_1_1_m"] = cs.Unknown(0.0, prior=(0.0, CURVATURE_1_M))
        parameters[f"{name}.curvature_2_1_m"] = 0.0
        parameters[f"{name}.twist_1_m"] = 0.0
    return cs.Problem(experiments, parameters)


def twisted_loop(loop_m: Array, mass_per_length_kg_m: float, twists_deg: Array) -> cs.Experiment:
    """Return the equilibria of a loop at twists (T,) of its last clamp about its own axis, which are
    the times of the samples.
    """
    body = hanging_wire(loop_m, mass_per_length_kg_m)
    mesh = body.mesh
    assert isinstance(mesh, cs.RodMesh)
    centres = mesh.centres_of_sections_m
    first, second, third = mesh.points_m[-3:]
    axis = np.cross(second - first, third - first)  # across the last section
    axis /= np.linalg.norm(axis)
    turns = Rotation.from_rotvec(np.radians(twists_deg)[:, None] * axis).as_matrix()
    poses = np.tile(np.eye(4), (len(twists_deg), 1, 1))
    still = poses.copy()
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = centres[-1] - turns @ centres[-1]
    length_m = float(mesh.s_m[-1])
    seen_m = centres[1:-1]
    return cs.Experiment(
        body,
        twists_deg,
        [cs.Grasp(Along(0.0, 0.0), still), cs.Grasp(Along(length_m, length_m), poses)],
        cs.Markers(
            twists_deg, np.zeros((len(twists_deg), len(seen_m), 3)), SIGMA_M, places_m=seen_m
        ),
        kind="static",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


def values_of(bending_n_m2: float, ratio: float) -> dict[str, float]:
    """Return the constants of a wire without natural curvature."""
    fixed = {"axial_n": AXIAL_N, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    return {"bending_n_m2": bending_n_m2, "torsion_n_m2": ratio * bending_n_m2} | fixed


def critical_twist_deg(
    loop_m: Array, mass_per_length_kg_m: float, bending_n_m2: float, ratio: float
) -> float:
    """Return the twist [°] at which a loop loses its stability, to `TWIST_STEP_DEG`; NaN if it is not
    found.
    """
    twists = np.arange(0.0, LARGEST_TWIST_DEG, TWIST_STEP_DEG)
    try:
        cs.simulate(
            twisted_loop(loop_m, mass_per_length_kg_m, twists), values_of(bending_n_m2, ratio)
        )
    except cs.SimulationError as error:
        if error.stability_loss is None:
            return np.nan
        return error.time_s - TWIST_STEP_DEG / 2
    return np.inf


def ratio_at(
    loop_m: Array, mass_per_length_kg_m: float, bending_n_m2: float, twist_deg: Array
) -> Array:
    """Return GJ/EI with which a loop loses its stability at measured twists, by interpolation."""
    found = [critical_twist_deg(loop_m, mass_per_length_kg_m, bending_n_m2, r) for r in RATIOS]
    print("GJ/EI and critical twist:", dict(zip(RATIOS, found, strict=True)), flush=True)
    known = np.isfinite(found)
    order = np.argsort(np.array(found)[known])
    twists, ratios = np.array(found)[known][order], np.array(RATIOS)[known][order]
    return np.exp(np.interp(np.log(twist_deg), np.log(twists), np.log(ratios), np.nan, np.nan))


def fitted(problem: cs.Problem) -> tuple[cs.Run, str]:
    """Return a run, and EI, its interval, the RMS distance [mm] and the verdict as cells of a table."""
    run = cs.run(problem)
    low, high = run.interval("bending_n_m2")
    value = run.estimates["bending_n_m2"].value
    rms = 1e3 * run.solution.rms_m
    return (
        run,
        f"{1e3 * value:.3f} | {1e3 * low:.3f} to {1e3 * high:.3f} | {rms:.2f} | {run.trust.verdict}",
    )


def mean_of_shapes(runs: Sequence[cs.Run]) -> Array:
    """Return the mean of EI [N m²] and its 95 % interval (3,), from fits of single shapes; χ² of the
    values and the correlation of the natural curvatures are printed.

    The error of a value is that of the natural curvature, mainly. Between two shapes it is as
    correlated as the estimated curvatures are.
    """
    values = np.log(np.array([each.parameters["bending_n_m2"] for each in runs]))
    bounds = np.log(np.array([each.interval("bending_n_m2") for each in runs]))
    errors = (bounds[:, 1] - bounds[:, 0]) / 3.92
    weights = errors**-2 / np.sum(errors**-2)
    mean = weights @ values
    names = [name for name in runs[0].parameters if name.endswith(".curvature_1_1_m")]
    curvatures = np.array([[each.parameters[name] for name in names] for each in runs])
    correlations = np.atleast_2d(np.corrcoef(curvatures))
    shared = np.mean(correlations[np.triu_indices(len(runs), 1)])
    print(f"chi2 {np.sum(((values - mean) / errors) ** 2):.2f} of {len(runs)} values")
    print(f"correlation of natural curvatures {shared:.2f}:\n{correlations.round(2)}", flush=True)
    covariance = np.outer(errors, errors) * (shared + (1 - shared) * np.eye(len(runs)))
    half = 1.96 * np.sqrt(weights @ covariance @ weights)
    return np.exp(mean + half * np.array([0.0, -1.0, 1.0]))


def draw(loops: dict[str, tuple[Array, Array, Array]]) -> None:
    """Draw for each wire the drawn points, the fitted shape, and the shape without natural curvature."""
    figure, axes = plt.subplots(
        1, len(loops), figsize=(6.4, 5.6), sharey=True, layout="constrained"
    )
    for axis, (name, (points, fit, straight)) in zip(axes, loops.items(), strict=True):
        axis.plot(1e3 * straight[:, 0], 1e3 * straight[:, 2], "--", label="no natural curvature")
        axis.plot(1e3 * fit[:, 0], 1e3 * fit[:, 2], label="natural curvature of twenty parts")
        axis.plot(
            1e3 * points[:, 0], 1e3 * points[:, 2], "k.", ms=4, label="points of the photograph"
        )
        axis.set(title=name, xlabel="x [mm]", aspect="equal")
    axes[0].set_ylabel("z [mm]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8
    )
    figure.savefig(PICTURES / "wires_shapes.png", dpi=RESOLUTION_DPI)


def draw_twists(curves: dict[str, tuple[Array, Array, Wire]]) -> None:
    """Draw the distance of each loop from its plane against the twist of its clamp."""
    figure, axis = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for k, (name, (twists, away, wire)) in enumerate(curves.items()):
        axis.plot(twists, 1e3 * away, color=f"C{k}", label=f"{name}, simulated")
        axis.axvspan(min(wire.twist_deg), max(wire.twist_deg), color=f"C{k}", alpha=0.3)
    axis.set(xlabel="twist of one clamp [°]", ylabel="distance from the plane [mm]")
    axis.legend(title="bands: measured critical twists")
    figure.savefig(PICTURES / "wires_twist.png", dpi=RESOLUTION_DPI)


def shape_m(solution: cs.Solution) -> Array:
    """Return the centreline (N, 3) [m] of the first loop of a solution."""
    iterate = solution.collocation.iterates(solution.z)[0]
    return centres_of_sections(iterate.x.reshape(-1, 3))


def main() -> None:
    """Print the tables, and draw the pictures."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, help="folder of the photographs' points")
    parser.add_argument("--wires", nargs="*", default=[wire.name for wire in WIRES])
    parser.add_argument("--twist-only", action="store_true", help="with the authors' EI")
    arguments = parser.parse_args()
    shapes: dict[str, tuple[Array, Array, Array]] = {}
    curves: dict[str, tuple[Array, Array, Wire]] = {}
    for wire in (each for each in WIRES if each.name in arguments.wires):
        loops = [read_loop(arguments.folder / f"{wire.name}_{k}.csv") for k in range(PHOTOGRAPHS)]
        density, guess = wire.mass_per_length_kg_m, wire.bending_n_m2
        bending = [guess]
        if not arguments.twist_only:
            print(f"\n{wire.name}\n")
            print(
                "| shape | EI mN m² and RMS mm, without natural curvature | EI | 95 % | RMS mm | verdict |"
            )
            print("|---|---|---|---|---|---|")
            runs = []
            for k, loop in enumerate(loops):
                plain = cs.solve(loops_problem([loop], density, guess, parts=0))
                run, cells = fitted(loops_problem([loop], density, guess))
                value = 1e3 * plain.parameters["bending_n_m2"]
                print(f"| {k} | {value:.3f}, {1e3 * plain.rms_m:.1f} | {cells} |", flush=True)
                runs.append(run)
                if k == 0:
                    shapes[wire.name] = (loop, shape_m(run.solution), shape_m(plain))
            bending = mean_of_shapes(runs).tolist()
            print("| mean | |", " to ".join(f"{1e3 * value:.3f}" for value in bending), "|")
            joint = loops_problem(loops, density, guess)
            found = cs.solve(joint)
            cells = f"{found.status.value}, {1e3 * found.rms_m:.2f} mm"
            if found.status.converged:
                _, cells = fitted(joint)
            print(f"| all with the same natural curvature | | {cells} |", flush=True)
        for value in bending:
            measured = np.array([np.mean(wire.twist_deg), min(wire.twist_deg), max(wire.twist_deg)])
            ratios = ratio_at(loops[0], density, value, measured)
            print(
                f"EI {1e3 * value:.4g} mN m²: GJ/EI {np.round(ratios, 3)} at {measured}", flush=True
            )
            if value == bending[0]:
                critical = critical_twist_deg(loops[0], density, value, float(ratios[0]))
                twists = np.append(0.0, np.arange(5.0, critical, 10.0))
                motion = cs.simulate(
                    twisted_loop(loops[0], density, twists), values_of(value, float(ratios[0]))
                )
                away = np.abs(motion.markers_m[:, :, 1]).max(axis=1)
                curves[wire.name] = (twists, away, wire)
    if shapes and len(shapes) == len(WIRES):
        draw(shapes)
        draw_twists(curves)


if __name__ == "__main__":
    main()
