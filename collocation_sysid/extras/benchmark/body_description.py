"""Text of a benchmark folder for readers: task, material, metric and format of the predictions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

# Definitions of the laws of the bodies; those of all laws are in docs/theory.md.
LAWS = {
    "neo-hookean": "ψ = ½ λ (ln J)² − μ ln J + ½ μ (tr C − 3)",
    "mooney-rivlin": "ψ = C₁₀ (Ī₁ − 3) + C₀₁ (Ī₂ − 3) + ½ κ (J − 1)²",
    "yeoh": "ψ = C₁₀ (Ī₁ − 3) + C₂₀ (Ī₁ − 3)² + C₃₀ (Ī₁ − 3)³ + ½ κ (J − 1)²",
    "ogden-3": "ψ = Σ μₚ/αₚ (λ̄₁^αₚ + λ̄₂^αₚ + λ̄₃^αₚ − 3) + ½ κ (J − 1)², p = 1, 2, 3",
}
DAMPING_LAWS = {
    "rayleigh": "force −γ_r K v − γ_m M v, with the tangent stiffness K and the lumped mass M",
    "kelvin-voigt": "stress S = 2 γ_r μ C⁻¹ Ė C⁻¹ + γ_r λ (C⁻¹ : Ė) C⁻¹ (second Piola–Kirchhoff), "
    "and force −γ_m M v with the lumped mass M",
}
NOTATION = (
    "F: deformation gradient; J = det F; C = FᵀF; Green strain E = ½ (C − I); Ī₁ = J^(−2/3) tr C; "
    "Ī₂ = J^(−4/3) ½ ((tr C)² − tr C²); λ̄ᵢ = J^(−1/3) λᵢ with the principal stretches λᵢ."
)
# Addresses of licences that require a link.
LICENCE_LINKS = {"CC BY 4.0": "https://creativecommons.org/licenses/by/4.0/"}
STARTS = {
    "equilibrium": "at rest in static equilibrium with gravity in its grasp at the first time",
    "undeformed": "undeformed and at rest at the first time",
}
METRIC = """## Metric

- `RMS`: root mean square of the distances between predicted and measured markers, over all markers
  and times at which they were seen; of loads, of the differences of all measured values.
- `% of deflection`: RMS over the largest distance of a measured marker from the undeformed body,
  which the grasp moves rigidly. For loads, `% of largest load`.
- `of noise`: RMS of the differences (of each coordinate) over the stated standard deviation σ. A
  value of 1 means that the prediction is as accurate as stated for the measurement.
- `without offsets`: RMS of the distances after the mean difference of each marker is subtracted.
  Errors of the positions of the markers on the body hardly change this value.

Two baselines are scored beside the prediction: the simulation of collocation_sysid with the
constants of `body.json`, and the undeformed body, which its grasp moves rigidly and which has no
loads.
"""
FOLDER_README = f"""# Benchmark of simulators

Each folder has a body with identified constants, and recordings that a simulator should predict.
`README.md` there states the task, `body.json` has all numbers. Units are SI. No package is needed
to read the files.

## Predictions

Write one file for each recording into the folder of its body: `RECORDING_prediction.csv` or
`RECORDING_prediction.npz`.

- A CSV table has the header and the columns of `RECORDING_measured.csv`, values without units, and a
  row for each row of `RECORDING_times.csv`. Further rows, such as all time steps, and further columns
  are ignored. No cell may be blank, also where the measurement is.
- An NPZ archive has the array `t_s` (N,), or `sample` where the table has that column, and the array
  `values` (N, C) with the columns in the same order; of M markers also (N, M, 3).

Then `collocation-sysid benchmark FOLDER` prints the scores; `--body NAME` scores one body, and
`--json` prints all numbers. Other files must not be changed.

{METRIC}"""


def body_readme(content: Mapping[str, Any]) -> str:
    """Return the README of a body as one text of Markdown, with a section for each recording.

    `content` is that of body.json: `_body_content` of `folder`, with "recordings".
    """
    parts = [
        f"# {content['body']}\n",
        *_introduction(content),
        *_material(content),
        *_mesh(content),
    ]
    for recording in content["recordings"]:
        parts += _recording(recording)
    return "\n".join([*parts, METRIC])


def _introduction(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield specimen, note, source and licence."""
    kind = (
        "Measured data."
        if content["is_measured"]
        else "**Simulated data**: recorded in a simulation with the true values below, with noise."
    )
    yield f"{content['specimen']}. {kind}\n"
    if content["note"]:
        yield f"{content['note']}\n"
    licence = content["licence"]
    link = LICENCE_LINKS.get(licence)
    yield f"- Source: {content['source']}."
    yield f"- Licence of the recordings: {licence}{f', {link}' if link else ''}."
    yield "- Changes: only the samples that are scored, in SI units and in the frame of the mesh.\n"


def _material(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines of the Markdown section on the material: laws, density, a table of the constants,
    and the recordings from which they were identified.

    The table has name, unit, value, combined interval ("stated" or "none" instead where it is None)
    and true value (empty where it is None) of each constant.
    """
    yield "## Material\n"
    yield f"- Energy density, law `{content['law']}`: {content['energy']}."
    if content["damping"]:
        yield f"- Damping, law `{content['damping']}`: {content['damping_force']}."
    if content["density_kg_m3"] is not None:
        yield f"- Density: {content['density_kg_m3']:.6g} kg/m³."
    yield f"- {NOTATION}\n"
    yield "| constant | unit | value | combined 95 % interval | true value |"
    yield "|---|---|---|---|---|"
    for each in content["constants"]:
        interval = each["combined95"]
        shown = "stated" if each["is_stated"] else "none"
        if interval:
            shown = f"{interval[0]:.5g} to {interval[1]:.5g}"
        true = "" if each["true_value"] is None else f"{each['true_value']:.6g}"
        yield (f"| `{each['name']}` | {each['unit']} | {each['value']:.8g} | {shown} | {true} |")
    fitted = ", ".join(content["identified_from"])
    yield f"\nIdentified from the recordings {fitted}. The interval contains noise,"
    yield "discretisation and systematic effects.\n"


def _mesh(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield the files of the mesh, which homogeneous tests have too, and their use."""
    yield "## Mesh\n"
    yield "`mesh.vtu`, and the same as tables: `nodes.csv` with the undeformed, stress-free nodes, and"
    yield "`tetrahedra.csv` with the nodes of each tetrahedron. Indices count from 0, in the order of"
    yield "the rows."
    if content["element"] is None:
        yield "The test is homogeneous: a single element, or any mesh of a cube, has the same stresses."
    else:
        yield (
            f"The constants were identified with elements `{content['element']}` on this mesh; another "
            "mesh may be used."
        )
    yield ""


def _recording(recording: Mapping[str, Any]) -> Iterator[str]:
    """Yield task, files and the format of the prediction of a recording."""
    name = recording["file_name"]
    files = recording["files"]
    held_out = (
        "held out: the constants were identified without it"
        if recording["is_held_out"]
        else "not held out: the constants were identified from it"
    )
    yield f"## Recording {recording['name']}\n"
    yield f"- This recording is {held_out}."
    if recording["quantity"] == "stresses":
        yield from _homogeneous_test(files)
    else:
        yield from _motion(recording)
    if recording["quantity"] == "markers":
        yield (
            f"- Predict the position of each marker [m] at the times of `{files['times']}`. "
            f"`{files['markers']}` has the markers: position on the undeformed body, element, and "
            "weights of its corners, with which a linear element gives the position."
        )
    yield f"- Measurements: `{files['measured']}`; a blank cell was not measured."
    yield f"- Write the prediction to `{name}_prediction.csv` with the columns"
    yield f"  `{','.join((recording['key'], *recording['columns']))}`,"
    yield f"  or to `{name}_prediction.npz`, see `../README.md`.\n"


def _homogeneous_test(files: Mapping[str, str]) -> Iterator[str]:
    """Yield the given stretches, and the stresses to be predicted."""
    yield (
        f"- `{files['stretches']}` has the stretches along x, y and z of each sample. Where a cell is "
        "blank, the stretch is free and the stress along that axis vanishes. Shear is zero."
    )
    yield (
        "- Predict the nominal stresses (force over undeformed area) [Pa]: `stress_zz_pa` along z, "
        f"`stress_xx_pa` along x, of the samples of `{files['times']}`."
    )


def _motion(recording: Mapping[str, Any]) -> Iterator[str]:
    """Yield gravity, start, air and grasps, and the forces to be predicted if they are."""
    gravity = ", ".join(f"{value:.6g}" for value in recording["gravity_m_s2"])
    yield f"- Gravity: [{gravity}] m/s²."
    if recording["kind"] == "static":
        yield "- Each sample is a static equilibrium."
    else:
        yield f"- The body is {STARTS[recording['start']]}."
        air = recording["air_density_kg_m3"]
        yield (
            f"- Air of {air:g} kg/m³ surrounds the body; our simulation has its buoyancy, added mass "
            "and drag."
            if air
            else "- No air: the recording was simulated without it."
        )
    for number, grasp in enumerate(recording["grasps"], start=1):
        axes = " and ".join(grasp["axes"])
        motion = (
            f"move as `{grasp['poses']}` states: a node at X of the undeformed mesh is at R X + p, "
            "with the rotation R of the quaternion and the position p"
            if grasp["poses"]
            else "do not move"
        )
        yield f"- Grasp {number}: the nodes of `{grasp['nodes']}` {motion}; along {axes}."
    if recording["quantity"] == "forces":
        yield (
            "- Predict the force [N] that the grasp named by the column exerts on the complete "
            f"specimen, which is {recording['symmetry']} times that on the mesh, at the times of "
            f"`{recording['files']['times']}`."
        )
