"""Small problems with one mistake in their description, or an effect that the laws lack.

Specimens are in closed form where there is one; other recordings are simulated. Each function
returns the wrong problem; where it has an argument, another value of it gives the right one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.recording.loads import PointMass
from kit import filmed
from kit.rods import cable, straight

UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Bodies that are simulated with their own mesh have none of the errors of real ones.
SIMULATED = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


# Specimens ----------------------------------------------------------------------------------------


def sheared_as_planar(law: str) -> cs.Problem:
    """Simple shear of one Ogden term, γ = λ − 1/λ, that is read as planar tension."""
    stretch = np.linspace(1.05, 1.6, 14)
    mu_pa, alpha = 30e3, 5.0
    shear_pa = mu_pa * (stretch**alpha - stretch**-alpha) / (stretch + 1 / stretch)
    specimen = cs.Specimen(
        "planar", stretch - 1 / stretch, shear_pa + 500 * rng().normal(size=14), 500.0
    )
    names = {"yeoh": ("c10_pa", "c20_pa", "c30_pa"), "ogden-1": ("mu_1_pa", "alpha_1")}[law]
    unknown = {name: cs.Unknown() for name in names}
    return cs.Problem([specimen.experiment(law, "one")], unknown | {"kappa_pa": 1e9})


def with_toe(law: str = "linear", test: str = "uniaxial", sign: int = -1) -> cs.Problem:
    """Test to a strain of 4 % with faces or grips that hold the whole section from about 1.5 % on."""
    strain = np.linspace(0, 0.04, 41)
    stress_pa = 9e5 * (strain - 0.006 * (1 - np.exp(-strain / 0.006)))
    stress_pa = stress_pa + 200 * rng().normal(size=41)
    specimen = cs.Specimen(test, sign * strain, sign * stress_pa, 200.0).experiment(law, "one")
    parameters: dict[str, cs.Unknown | float]
    if law == "linear":
        parameters = {"young_pa": cs.Unknown(), "poisson": 0.49}
    else:
        parameters = {"c10_pa": cs.Unknown(), "c01_pa": cs.Unknown(), "kappa_pa": 1e9}
    return cs.Problem([specimen], parameters)


def rubber_with_slack(left_out: float = 0.0) -> cs.Problem:
    """Strip of E = 900 kPa to a stretch of 1.2, slack below a strain of about 2 %; without the rows
    of strains below `left_out`.
    """
    strain = np.linspace(0, 0.2, 61)
    stretch = 1 + strain - 0.006 * (1 - np.exp(-strain / 0.006))
    stress_pa = 3e5 * (stretch - stretch**-2) + 200 * rng().normal(size=61)
    used = strain >= left_out
    specimen = cs.Specimen("uniaxial", strain[used], stress_pa[used], 200.0, strain_zero=0.02)
    parameters = {"young_pa": cs.Unknown(), "poisson": 0.499}
    return cs.Problem([specimen.experiment("neo-hookean", "one")], parameters)


FIBRES = cs.Fibres(direction=[0, 0, 1.0])
REINFORCED = {"mu_pa": 1e5, "kappa_pa": 1e8, "fibre_pa": 2e6} | UNDAMPED


def _strips(strain: np.ndarray, angles_deg: dict[str, tuple[float, float]]) -> cs.Problem:
    """Strips of a sheet with fibres, each with the angle of its cut and the stated one."""
    noise = rng()

    def strip(name: str, angle_deg: float, stress_pa: np.ndarray) -> cs.Experiment:
        specimen = cs.Specimen("uniaxial", strain, stress_pa, 500.0, cut_angle_deg=angle_deg)
        return specimen.experiment("neo-hookean", name, fibres=FIBRES)

    strips = []
    for name, (real_deg, stated_deg) in angles_deg.items():
        real = strip(name, real_deg, np.zeros(len(strain)))
        stress_pa = cs.simulate(real, REINFORCED).custom_sensor_values[0][:, 0]
        strips.append(strip(name, stated_deg, stress_pa + 500 * noise.normal(size=len(strain))))
    unknown = {"mu_pa": cs.Unknown(), "kappa_pa": 1e8, "fibre_pa": cs.Unknown()}
    return cs.Problem(strips, unknown)


def cut_at_another_angle() -> cs.Problem:
    """Two strips along the fibres, of which one was cut at 30°."""
    strain = np.linspace(0.01, 0.15, 8)
    return _strips(strain, {"along": (0.0, 0.0), "turned": (30.0, 0.0)})


def fibres_in_compression(with_second: bool) -> cs.Problem:
    """Strips that are compressed, with fibres that carry tension only."""
    angles_deg = {"along": (0.0, 0.0)} | ({"turned": (30.0, 30.0)} if with_second else {})
    return _strips(-np.linspace(0.01, 0.15, 15), angles_deg)


def with_few_branches(with_second: bool) -> cs.Problem:
    """Storage and loss modulus of four relaxation times, one of which is described; two tables
    with `with_second`, of a cold and a warm specimen.
    """
    shares, tau_s = np.array([0.5, 2.0, 1.0, 1.0]), np.array([10.0, 0.1, 1.0, 0.02])
    frequency_hz = np.geomspace(1e-2, 10.0, 9)
    noise = rng()
    tables = []
    for name, factor, shift in (("cold", 1.0, ""), ("warm", 1e-2, "warm"))[: 1 + with_second]:
        w = 2 * np.pi * frequency_hz[:, None] * tau_s * factor
        modulus_pa = 2e5 * (1 + (shares * 1j * w / (1 + 1j * w)).sum(axis=1))
        modulus_pa = modulus_pa * (1 + 0.01 * noise.normal(size=9))
        table = cs.Specimen.harmonic(
            frequency_hz, modulus_pa.real, modulus_pa.imag, 0.01, shift=shift
        )
        tables.append(table.experiment("neo-hookean", name, prony=("a",)))
    unknown = {"young_pa": cs.Unknown(), "poisson": 0.4999}
    unknown |= {"a.share": cs.Unknown(), "a.tau_s": cs.Unknown(1.0)}
    if with_second:
        unknown["warm.log10_shift"] = cs.Unknown(prior=(0.0, 3.0))
    return cs.Problem(tables, unknown)


# Motions ------------------------------------------------------------------------------------------


def ring_down(slow: float, left_s: float = 0.2) -> cs.Problem:
    """Cantilever whose tip mass leaves after 0.2 s, which the problem states as `left_s`, filmed at
    120 Hz, with times that are `slow` times as long.
    """
    body = cs.Body(
        cs.box_mesh((0.02, 0.12, 0.015), (1, 4, 1)),
        density_kg_m3=1000.0,
        element="tet10",
        rest_shape="stress_free",
    )
    t_s = np.arange(48) / 120
    held = cs.Grasp(cs.Box((-1, -1, -1), (1, 1e-6, 1)), cs.PoseSequence.fixed())
    tip = cs.Box((-1, 0.1199, -1), (1, 1, 1))
    places_m = [[0.01, 0.12, 0.0075], [0.01, 0.07, 0.015], [0.01, 0.095, 0.015]]

    def recorded(t_s: np.ndarray, tracks_m: np.ndarray, until_s: float) -> cs.Experiment:
        markers = cs.Markers(t_s, tracks_m, 3e-4, places_m=places_m)
        mass = PointMass(tip, 0.010, until_s=until_s)
        keys: dict[str, Any] = {"masses": [mass], "air_density_kg_m3": "none", "name": "ring"}
        return cs.Experiment(body, t_s, [held], markers, gravity_m_s2=(0, 0, -9.81), **keys)

    truth = {"young_pa": 2e6, "poisson": 0.45, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.0}
    real = recorded(t_s, np.zeros((48, 3, 3)), 0.2)
    tracks_m = cs.simulate(real, truth, "midpoint", substeps=1).markers_m
    tracks_m = tracks_m + 3e-4 * rng().normal(size=tracks_m.shape)
    unknown = truth | {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown()}
    keys = {"scheme": "midpoint", "substeps": 1, "uncertainty": SIMULATED}
    return cs.Problem([recorded(slow * t_s, tracks_m, left_s)], unknown, **keys)


def rolling_shutter(stated_s: float) -> cs.Problem:
    """Bar that is filmed by a camera whose rows are exposed 20 µs after each other."""
    delay_s, noise_px = 2e-5, 0.2
    t_s = filmed.T_S
    share = 0.5 * (1 - np.cos(2 * np.pi * t_s / 0.2))
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, 1, 3], poses[:, 2, 3] = 0.015 * share, 0.01 * share
    grasps = [cs.Grasp(np.flatnonzero(filmed.bar().nodes_m[:, 0] < 1e-9), poses)]
    moved = cs.simulate(replace(filmed.swung(), grasps=grasps), filmed.TRUTH)
    track_m = CubicSpline(t_s, moved.markers_m)
    camera = filmed.filming("front")
    pixels = filmed.projected(camera, track_m(t_s))
    for _ in range(6):  # the time of a row depends on the row
        own_s = np.minimum(t_s[:, None] + delay_s * pixels[..., 1], t_s[-1])
        seen_m = np.stack([track_m(own_s[:, k])[:, k] for k in range(own_s.shape[1])], axis=1)
        pixels = filmed.projected(camera, seen_m)
    pixels = pixels + noise_px * rng().normal(size=pixels.shape)
    ended = slice(len(t_s) - 3)
    places_m = list(filmed.PLACES_M.values())
    keys = filmed.EXACT | {"sigma_px": noise_px, "places_m": places_m, "line_delay_s": stated_s}
    tracks = cs.ImageTracks("front", camera, t_s[ended], pixels[ended], filmed.NAMES, **keys)
    unknown = filmed.TRUTH | {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown()}
    swing = replace(filmed.swung([tracks]), grasps=grasps)
    return cs.Problem([swing], unknown, uncertainty=SIMULATED)


SOFT = {"young_pa": 5e4, "poisson": 0.4, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.5}


def _swung(
    body: cs.Body, t_s: np.ndarray, places_m: np.ndarray, wrench: cs.Wrench | None = None
) -> cs.Experiment:
    """A body that is held at its lower end, and moved and turned there."""
    share = 0.5 * (1 - np.cos(2 * np.pi * t_s / 0.4))
    shift_m = np.outer(share, [0.02, 0.012, 0.0])
    turn = Rotation.from_euler("z", 0.3 * share[:, None]).as_quat()
    moved = cs.PoseSequence(t_s, shift_m, turn)
    held = cs.Grasp(cs.Box((-1, -1, -1), (1, 1, 1e-6)), moved, wrench=wrench)
    markers = cs.Markers(t_s, np.zeros((len(t_s), len(places_m), 3)), 3e-4, places_m=places_m)
    keys: dict[str, Any] = {"nuisance": cs.Nuisance.none(), "air_density_kg_m3": "none"}
    keys |= {"gravity_m_s2": (0, 0, -9.81), "name": "swing"}
    return cs.Experiment(body, t_s, [held], markers, **keys)


def _problem(experiment: cs.Experiment) -> cs.Problem:
    unknown = SOFT | {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown()}
    return cs.Problem([experiment], unknown, uncertainty=SIMULATED)


def _bent(is_mirrored: bool) -> cs.Body:
    mesh = cs.box_mesh((0.02, 0.02, 0.1), (1, 1, 4))
    points_m = mesh.points_m + np.outer((mesh.points_m[:, 2] / 0.1) ** 2, (0.03, 0.012, 0))
    points_m[:, :2] -= 0.01
    cells = mesh.tetrahedra
    if is_mirrored:
        points_m, cells = points_m * [-1, 1, 1], cells[:, [0, 2, 1, 3]]
    return cs.Body(cs.TetMesh(points_m, cells), density_kg_m3=1000.0, rest_shape="stress_free")


def mirrored_mesh(is_mirrored: bool) -> cs.Problem:
    """A bent bar with markers at unknown places, and the mirror image of its mesh."""
    t_s = 0.01 * np.arange(41)
    corners = np.array([[1, 1, 10], [-1, 1, 10], [1, -1, 7.5], [-1, -1, 5]]) * 0.01
    places_m = corners + np.outer((corners[:, 2] / 0.1) ** 2, (0.03, 0.012, 0))
    real = _swung(_bent(False), t_s, places_m)
    tracks_m = cs.simulate(real, SOFT).markers_m
    markers = cs.Markers(t_s, tracks_m + 3e-4 * rng().normal(size=tracks_m.shape), 3e-4)
    return _problem(replace(real, body=_bent(is_mirrored), markers=markers))


def round_rod(section: str, young_pa: float = 2e5, density_kg_m3: float = 1000.0) -> cs.Problem:
    """A round rod of known density with a sensor at its end, meshed with a round or a square section
    of the same width.
    """
    t_s = 0.02 * np.arange(21)
    places_m = np.array([[0, 0, 0.1], [0.007, 0, 0.1], [0, 0.009, 0.05]])
    sigma = 1e-2, 1e-3  # N, N m

    def swung(section: str, loads: np.ndarray) -> cs.Experiment:
        box = cs.box_mesh((0.02, 0.02, 0.1), (2, 2, 3))
        mesh = cs.TetMesh(box.points_m - [0.01, 0.01, 0], box.tetrahedra)
        if section == "round":
            polygon = cs.cylinder_mesh(0.01, 0.1, 2, 3)
            wider = np.sqrt(np.pi / 4 * mesh.volume_m3 / polygon.volume_m3)
            mesh = cs.TetMesh(polygon.points_m * [wider, wider, 1], polygon.tetrahedra)
        body = cs.Body(mesh, density_kg_m3=density_kg_m3)
        return _swung(body, t_s, places_m, wrench=cs.Wrench(t_s, loads, *sigma))

    stiff = SOFT | {"young_pa": young_pa}
    real = cs.simulate(swung("round", np.zeros((21, 6))), stiff)
    noise = rng()
    tracks_m = real.markers_m + 3e-4 * noise.normal(size=real.markers_m.shape)
    loads = real.wrenches[0] + noise.normal(size=(21, 6)) * np.repeat(sigma, 3)
    return _problem(cs.with_markers(swung(section, loads), tracks_m))


# Cables -------------------------------------------------------------------------------------------


def cable_with_marker_at(stated_m: float) -> cs.Problem:
    """A swung cable whose middle marker is at 0.3 m."""
    mesh = straight(0.6, cs.CrossSection.round(0.006), 16)
    t_s = 0.02 * np.arange(41)
    sway_m = np.outer(0.05 * (1 - np.cos(6 * t_s)), [1, 0.5, 0.2])
    hand = cs.PoseSequence(t_s, sway_m, np.tile([0, 0, 0, 1.0], (41, 1)))
    values = {"bending_n_m2": 1e-3, "torsion_n_m2": 3e-4, "axial_n": 200.0}
    values |= {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}

    def hung(middle_m: float, tracks_m: np.ndarray) -> cs.Experiment:
        places_m = [mesh.place_m(middle_m), mesh.place_m(0.6)]
        markers = cs.Markers(t_s, tracks_m, 5e-4, ["middle", "tip"], places_m=places_m)
        body = cable(mesh)
        return cs.Experiment(
            body, t_s, [cs.Grasp(range(3), hand)], markers, air_density_kg_m3="none"
        )

    tracks_m = cs.simulate(hung(0.3, np.zeros((41, 2, 3))), values).markers_m
    seen = hung(stated_m, tracks_m + 5e-4 * rng().normal(size=tracks_m.shape))
    unknown = {name: cs.Unknown() for name in ("bending_n_m2", "gamma_r_s", "gamma_m_1_s")}
    return cs.Problem([seen], values | unknown)
