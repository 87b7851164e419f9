"""OpenUSD: a tetrahedral mesh, or the centreline of a rod, with the schemas for deformable bodies
that Newton and Isaac read.

The schemas are those of the proposal for deformables in USD physics. They have Young's modulus,
Poisson's ratio, density and masses; those of curves have stiffnesses over the area and the second
moments of a circle of their thickness. Damping is stored in custom attributes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...errors import InputError, printable
from ...kinds.rod.element import CrossSection, RodMaterial, RodMesh, frames_of_sections
from ...recording import Grasp, Obstacle
from .identified import IdentifiedBody, IdentifiedRegion
from .newton import compare_at_rest
from .obstacle_shapes import Primitive
from .target import (
    ExportedFiles,
    PredictionComparison,
    TargetCapabilities,
    comment_lines,
    linear_tetrahedra,
    require_known_laws,
)

STAGE_FILE = "body.usda"
ATTRIBUTE_NAMESPACE = "collocationSysid"
MESH_PATH = "/World/Body/Mesh"  # of the mesh or the centreline
CAPABILITIES = TargetCapabilities(
    stiffness_damping="damping γ_r is not part of the USD schemas: it is exported as a custom attribute",
    mass_damping="γ_m = {gamma_m_1_s:.4g} 1/s is not part of the USD schemas: it is exported as a custom "
    "attribute",
    point_masses="point masses on nodes are not exported",
    has_moving_grasps=True,
    has_moving_obstacles=True,
    has_rounded_edges=False,
    has_face_selection=False,
)
SINGLE_PRECISION = "numbers are single precision"
READERS_LAW = (
    "the stage states E and ν, and its reader chooses the law: Newton has stable-neo-hookean, the "
    "identified one"
)
REGIONS = (
    "regions are subsets of tetrahedra, each with its material; a simulator with one material "
    "per body, such as Newton 1.8, uses that of the largest"
)
TILT = (
    "gravity points {degrees:.3g}° away from −z of the stage, as estimated from the recording; a "
    "simulator that uses its magnitude only, along −z, ignores this"
)
NO_SIMULATION = (
    "the points of the body are those of the first sample: the run has no forward simulation"
)
# Angle from which gravity counts as tilted: single precision of its direction rounds to less.
LEAST_TILT_DEG = 1e-3
# Frames per second of a single sample, which has no rate of its own.
SINGLE_RATE_HZ = 24.0
CURVE_ROUND = (
    "the section is a circle of the same stiffnesses; that of bending is the mean about both axes"
)
CURVE_NATURAL = "natural curvature and twist are not part of the USD schemas"
SINGLE_AXES = "nodes that are held along single axes only are free"


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the USD stage as a text file, with bodies, grippers, obstacles and the simulated
    motion, and what the stage cannot express.

    Raises
    ------
    InputError
        For another law than that of Newton, or if usd-core is not installed.
    """
    require_known_laws(body, "usd")
    pxr = _import_usd()
    limits = [*CAPABILITIES.limitations(body), SINGLE_PRECISION]
    if body.body.is_solid:
        limits += [READERS_LAW, *[REGIONS] * (len(body.regions) > 1)]
    else:
        limits += _curve_limitations(body)
    limits += [SINGLE_AXES] * bool(
        (body.is_prescribed.any(axis=1) != body.is_node_prescribed).any()
    )
    limits += [NO_SIMULATION] * (body.simulated_m is None)
    tilt_deg = _tilt_deg(body.experiment.gravity_m_s2)
    limits += [TILT.format(degrees=tilt_deg)] * (tilt_deg > LEAST_TILT_DEG)
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    t_s = body.experiment.t_s
    rate_hz = _rate_hz(t_s)
    stage.SetTimeCodesPerSecond(rate_hz)
    stage.SetFramesPerSecond(rate_hz)
    stage.SetStartTimeCode(float(rate_hz * t_s[0]))
    stage.SetEndTimeCode(float(rate_hz * t_s[-1]))
    world = pxr.UsdGeom.Xform.Define(stage, "/World").GetPrim()
    stage.SetDefaultPrim(world)
    world.SetDocumentation(comment_lines(body, limits, start=""))
    scene = pxr.UsdPhysics.Scene.Define(stage, "/World/Physics")
    gravity = body.experiment.gravity_m_s2
    size = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(size)
    scene.CreateGravityDirectionAttr(pxr.Gf.Vec3f(*(gravity / (size or 1.0)).tolist()))
    placed_m = np.where(body.is_prescribed, body.prescribed_m, body.nodes_m)
    add = _add_mesh if body.body.is_solid else _add_curve
    add(pxr, stage, body=body, start_positions_m=placed_m)
    for k, grasp in enumerate(body.experiment.grasps, start=1):
        _add_gripper(pxr, stage, number=k, grasp=grasp, body=body, start_positions_m=placed_m)
    for k, obstacle in enumerate(body.obstacles, start=1):
        _add_obstacle(pxr, stage, path=f"/World/Obstacle_{k}", obstacle=obstacle, body=body)
    return ExportedFiles({STAGE_FILE: stage.GetRootLayer().ExportToString()}, tuple(limits))


def _rate_hz(t_s: Array) -> float:
    """Return time codes per second, on average where samples are uneven."""
    return (len(t_s) - 1) / float(np.ptp(t_s)) if len(t_s) > 1 else SINGLE_RATE_HZ


def _tilt_deg(gravity_m_s2: Array) -> float:
    """From 0 to 180 [°]; 0 without gravity."""
    downwards = -gravity_m_s2[2]
    across = np.linalg.norm(gravity_m_s2[:2])
    return float(np.degrees(np.arctan2(across, downwards))) if gravity_m_s2.any() else 0.0


def _import_usd() -> Any:
    """Return all modules in one object."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
    except ImportError as error:
        raise InputError("USD needs usd-core: pip install 'collocation-sysid[usd]'") from error
    modules = (Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt)
    return SimpleNamespace(**{each.__name__.rpartition(".")[2]: each for each in modules})


def _curve_limitations(body: IdentifiedBody) -> list[str]:
    """Return what a curve cannot express; raise an `InputError` for regions and point masses."""
    if len(body.regions) > 1 or body.point_masses_kg.any():
        raise InputError(
            "a cable with regions or point masses is not exported to usd; expected --to json"
        )
    law = body.body.parts[0].material
    assert isinstance(law, RodMaterial)
    about_1, about_2 = law.section.moments_m4
    is_round = np.isclose(about_1, about_2, atol=0)
    return [CURVE_NATURAL] * bool(law.natural_curvature) + [CURVE_ROUND] * (not is_round)


def _add_curve(pxr: Any, stage: Any, body: IdentifiedBody, start_positions_m: Array) -> None:
    """Add the centreline with the normal d₁ of each section."""
    curve = pxr.UsdGeom.BasisCurves.Define(stage, MESH_PATH)
    tokens = pxr.UsdGeom.Tokens
    curve.CreateTypeAttr(tokens.linear)
    curve.CreateWrapAttr(tokens.nonperiodic)
    prim = _add_points(pxr, stage, curve, body, start_positions_m, "PhysicsCurvesDeformableSimAPI")
    count = len(start_positions_m) // 3
    curve.CreateCurveVertexCountsAttr([count])
    part, region, mesh = body.body.parts[0], body.regions[0], body.body.mesh
    assert isinstance(part.material, RodMaterial)
    assert isinstance(mesh, RodMesh)
    section = part.material.section
    thickness_m = 2 * float(np.sqrt(np.prod(section.extent_m)))
    curve.CreateWidthsAttr([thickness_m])
    curve.SetWidthsInterpolation(tokens.constant)
    curve.SetNormalsInterpolation(tokens.vertex)
    types = pxr.Sdf.ValueTypeNames
    rest_m, frames = frames_of_sections(body.body.nodes_m)
    normals = frames[:, :, 1]
    if mesh.is_straight_at_rest:
        rest_m, normals = np.outer(mesh.s_m, [1, 0, 0]), np.tile([0, 1, 0], (count, 1))
    for name, kind, values in (
        ("restShapePoints", types.Point3fArray, rest_m),
        ("restNormals", types.Normal3fArray, normals),
    ):
        prim.CreateAttribute(f"physics:{name}", kind, False).Set(values.astype(np.float32))
    masses = prim.CreateAttribute("physics:masses", types.FloatArray, False)
    masses.Set(body.node_mass_kg.reshape(count, 3).sum(axis=1).astype(np.float32))
    held = body.is_node_prescribed.reshape(count, 3).all(axis=1)
    grasped = prim.CreateAttribute(f"{ATTRIBUTE_NAMESPACE}:graspedPoints", types.IntArray)
    grasped.Set(np.flatnonzero(held).astype(np.int32))
    shear, _, axial, bend_1, bend_2, twist = part.material.stiffness(
        [region.constants[constant.name] for constant in part.material.constants]
    )
    circle = CrossSection.round(thickness_m)
    (moment, _), area = circle.moments_m4, circle.area_m2
    values = {
        "physics:thickness": thickness_m,
        "physics:density": body.node_mass_kg.sum() / (area * mesh.s_m[-1]),
        "physics:stretchStiffness": axial / area,
        "physics:shearStiffness": shear / area,
        "physics:bendStiffness": (bend_1 + bend_2) / 2 / moment,
        "physics:twistStiffness": twist / circle.torsion_m4,
    }
    material = _add_material(pxr, stage, region, region.name, values, "Curves")
    _bind_material(pxr, prim, material=material)


def _add_points(
    pxr: Any, stage: Any, shape: Any, body: IdentifiedBody, start_positions_m: Array, schema: str
) -> Any:
    """Set the points of the body, and of a curve its normals; return its prim."""
    body_prim = pxr.UsdGeom.Xform.Define(stage, "/World/Body").GetPrim()
    body_prim.AddAppliedSchema("PhysicsDeformableBodyAPI")
    prim = shape.GetPrim()
    prim.AddAppliedSchema(schema)
    pxr.UsdPhysics.CollisionAPI.Apply(prim)
    is_curve = not body.body.is_solid
    points, normals = shape.CreatePointsAttr(), shape.CreateNormalsAttr() if is_curve else None
    t_s = body.experiment.t_s
    codes = (_rate_hz(t_s) * t_s).tolist()
    # Default positions for simulators; time samples for playback.
    times = [pxr.Usd.TimeCode.Default(), *([] if body.simulated_m is None else codes)]
    moving = () if body.simulated_m is None else body.simulated_m
    for time, nodes_m in zip(times, [start_positions_m, *moving], strict=True):
        placed_m = nodes_m
        if normals:
            placed_m, frames = frames_of_sections(nodes_m)
            normals.Set(frames[:, :, 1].astype(np.float32), time)
        points.Set(placed_m.astype(np.float32), time)
    return prim


def _add_mesh(pxr: Any, stage: Any, body: IdentifiedBody, start_positions_m: Array) -> None:
    mesh = pxr.UsdGeom.TetMesh.Define(stage, MESH_PATH)
    cells = linear_tetrahedra(body)
    prim = _add_points(pxr, stage, mesh, body, start_positions_m, "PhysicsVolumeDeformableSimAPI")
    mesh.CreateTetVertexIndicesAttr(np.concatenate(cells).astype(np.int32))
    mesh.CreateSurfaceFaceVertexIndicesAttr(pxr.UsdGeom.TetMesh.ComputeSurfaceFaces(mesh))
    number = pxr.Sdf.ValueTypeNames
    rest = prim.CreateAttribute("physics:restShapePoints", number.Point3fArray, False)
    rest.Set(body.nodes_m.astype(np.float32))
    masses = prim.CreateAttribute("physics:masses", number.FloatArray, False)
    masses.Set(_cell_masses_kg(body, cells).astype(np.float32))
    _set_token(pxr, prim, name="physics:masses:elementType", text="tetrahedron")
    grasped = prim.CreateAttribute(f"{ATTRIBUTE_NAMESPACE}:graspedPoints", number.IntArray)
    grasped.Set(np.flatnonzero(body.is_node_prescribed).astype(np.int32))
    names = _unique_prim_names([region.name for region in body.regions])
    pairs = zip(body.regions, names, strict=True)
    materials = [
        _add_material(
            pxr,
            stage,
            region,
            name,
            {
                "physics:youngsModulus": region.young_pa,
                "physics:poissonsRatio": region.poisson,
                "physics:density": region.density_kg_m3,
            },
            "Volume",
        )
        for region, name in pairs
    ]
    _bind_material(pxr, prim, material=materials[int(np.argmax([len(each) for each in cells]))])
    firsts = np.cumsum([0, *map(len, cells)])
    for k, material in enumerate(materials if len(cells) > 1 else ()):
        indices = pxr.Vt.IntArray(range(firsts[k], firsts[k + 1]))
        subset = pxr.UsdGeom.Subset.CreateGeomSubset(
            mesh, names[k], pxr.UsdGeom.Tokens.tetrahedron, indices, "materialBind"
        )
        _bind_material(pxr, subset.GetPrim(), material=material)


def _cell_masses_kg(body: IdentifiedBody, cells: list[Index]) -> Array:
    """Region after region, without points."""
    edges = [np.diff(body.nodes_m[each], axis=1) for each in cells]
    volumes = [np.abs(np.linalg.det(each)) / 6 for each in edges]
    pairs = zip(body.regions, volumes, strict=True)
    return np.concatenate([region.density_kg_m3 * volume for region, volume in pairs])


def _add_material(
    pxr: Any,
    stage: Any,
    region: IdentifiedRegion,
    name: str,
    physics: Mapping[str, float],
    kind: str,
) -> Any:
    """Add a region's material under /World/Materials/`name`."""
    material = pxr.UsdShade.Material.Define(stage, f"/World/Materials/{name}")
    prim = material.GetPrim()
    prim.AddAppliedSchema(f"Physics{kind}DeformableMaterialAPI")
    values = dict(physics) | {
        f"{ATTRIBUTE_NAMESPACE}:gammaR_s": region.gamma_r_s,
        f"{ATTRIBUTE_NAMESPACE}:gammaM_1_s": region.gamma_m_1_s,
    }
    values |= {f"{ATTRIBUTE_NAMESPACE}:{name}": value for name, value in region.constants.items()}
    number = pxr.Sdf.ValueTypeNames
    for name, value in values.items():
        prim.CreateAttribute(name, number.Float, name.startswith(ATTRIBUTE_NAMESPACE)).Set(
            float(value)
        )
    for name, text in (("material", region.material), ("damping", region.damping)):
        prim.CreateAttribute(f"{ATTRIBUTE_NAMESPACE}:{name}", number.String).Set(text)
    return material


def _bind_material(pxr: Any, prim: Any, material: Any) -> None:
    """Those of descendants prevail."""
    binding = pxr.UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(material, pxr.UsdShade.Tokens.weakerThanDescendants, "physics")


def _set_token(pxr: Any, prim: Any, name: str, text: str) -> None:
    kind = pxr.Sdf.ValueTypeNames.Token
    fixed = pxr.Sdf.VariabilityUniform
    prim.CreateAttribute(name, kind, False, fixed).Set(text)


def _add_gripper(
    pxr: Any, stage: Any, number: int, grasp: Grasp, body: IdentifiedBody, start_positions_m: Array
) -> None:
    """Attach the nodes to /World/Gripper_NUMBER that the grasp holds along all axes."""
    path = f"/World/Gripper_{number}"
    gripper = pxr.UsdGeom.Xform.Define(stage, path)
    pxr.UsdPhysics.RigidBodyAPI.Apply(gripper.GetPrim()).CreateKinematicEnabledAttr(True)
    matrices, positions_m = grasp.poses.at(body.experiment.t_s)
    _set_poses(
        pxr,
        gripper,
        positions_m=positions_m,
        rotations=Rotation.from_matrix(matrices),
        t_s=body.experiment.t_s,
    )
    nodes = np.intersect1d(grasp.nodes, np.flatnonzero(body.is_node_prescribed))
    points_m = start_positions_m
    if not body.body.is_solid:
        nodes, points_m = nodes[::3] // 3, frames_of_sections(start_positions_m)[0]
    prim = stage.DefinePrim(f"{path}/Grasp", "PhysicsAttachment")
    types = pxr.Sdf.ValueTypeNames
    for name, target in (("src0", MESH_PATH), ("src1", path)):
        prim.CreateRelationship(f"physics:{name}", False).SetTargets([pxr.Sdf.Path(target)])
    for name, text in (("type0", "point"), ("type1", "xform")):
        _set_token(pxr, prim, name=f"physics:{name}", text=text)
    local_m = (points_m[nodes] - positions_m[0]) @ matrices[0]
    for name, kind, values in (
        ("indices0", types.IntArray, nodes.astype(np.int32)),
        ("coords1", types.Vector3fArray, local_m.astype(np.float32)),
    ):
        prim.CreateAttribute(f"physics:{name}", kind, False).Set(values)


def _set_poses(pxr: Any, prim: Any, positions_m: Array, rotations: Rotation, t_s: Array) -> None:
    """The default pose is that of the first row."""
    codes = (_rate_hz(t_s) * t_s).tolist()
    wxyz = rotations.as_quat(scalar_first=True)
    place = prim.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble)
    turn = prim.AddOrientOp(pxr.UsdGeom.XformOp.PrecisionDouble)
    for k, time in enumerate([pxr.Usd.TimeCode.Default(), *codes]):
        row = max(k - 1, 0)
        place.Set(pxr.Gf.Vec3d(*positions_m[row].tolist()), time)
        turn.Set(pxr.Gf.Quatd(*wxyz[row].tolist()), time)


def _add_obstacle(
    pxr: Any, stage: Any, path: str, obstacle: Obstacle, body: IdentifiedBody
) -> None:
    """Rounded edges are left out."""
    shape = Primitive.from_solid(obstacle.shape)
    t_s = body.experiment.t_s
    frame = path
    if len(obstacle.poses.t_s) > 1:
        moving = pxr.UsdGeom.Xform.Define(stage, path)
        pxr.UsdPhysics.RigidBodyAPI.Apply(moving.GetPrim()).CreateKinematicEnabledAttr(True)
        matrices, places_m = obstacle.poses.at(t_s)
        _set_poses(
            pxr, moving, positions_m=places_m, rotations=Rotation.from_matrix(matrices), t_s=t_s
        )
        place_m = shape.centre_m
        turn = shape.rotation
        frame = f"{path}/Shape"
    else:
        place_m, turn = shape.pose_at(obstacle, body.start_s)
    kinds = {"box": "Cube"}
    solid = getattr(pxr.UsdGeom, kinds.get(shape.kind, shape.kind.title())).Define(stage, frame)
    _set_poses(
        pxr, solid, positions_m=place_m[None], rotations=Rotation.concatenate([turn]), t_s=t_s[:0]
    )
    if shape.kind == "box":
        solid.CreateSizeAttr(2.0)
        solid.AddScaleOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Vec3d(*shape.size_m))
    elif shape.kind != "plane":
        solid.CreateRadiusAttr(float(shape.size_m[0]))
    if shape.kind in ("plane", "cylinder", "capsule"):
        solid.CreateAxisAttr("Z")
    if shape.kind in ("cylinder", "capsule"):
        solid.CreateHeightAttr(2 * float(shape.size_m[1]))
    pxr.UsdPhysics.CollisionAPI.Apply(solid.GetPrim())
    solid.GetPrim().SetDisplayName(printable(obstacle.name))
    material = pxr.UsdShade.Material.Define(stage, f"/World/Materials/{path.rpartition('/')[2]}")
    rubbing = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    for attribute in (rubbing.CreateStaticFrictionAttr, rubbing.CreateDynamicFrictionAttr):
        attribute(float(obstacle.friction))
    _bind_material(pxr, solid.GetPrim(), material=material)


def _unique_prim_names(names: Sequence[str]) -> list[str]:
    """Return different names that USD accepts, in the same order."""
    unique: list[str] = []
    for name in names:
        text = re.sub(r"[^A-Za-z0-9_]", "_", name)
        text = text if re.match(r"[A-Za-z_]", text) else f"_{text}"
        while text in unique:
            text += "_"
        unique.append(text)
    return unique


def verify(body: IdentifiedBody, folder: Path) -> list[PredictionComparison]:
    """Run Newton on the exported stage until the body is at rest, and compare the largest
    displacement.

    Grasped nodes and obstacles stay at their positions of the first sample; the number of steps is
    fixed, and convergence is not checked.

    Parameters
    ----------
    body : IdentifiedBody
        Body that was exported.
    folder : Path
        Folder with the stage; nothing is written to it.

    Raises
    ------
    InputError
        If Newton is not installed, and for a rod.
    SimulationError
        If the equilibrium of this package cannot be computed.
    """
    if not body.body.is_solid:
        raise InputError("a cable is verified in MuJoCo alone; expected --to mujoco --verify")

    def add_to(builder: Any) -> None:
        # Grippers are left out, since Newton would simulate them too.
        builder.add_usd(str(folder / STAGE_FILE), ignore_paths=["/World/Gripper_.*"])

    return compare_at_rest(body, add_to)
