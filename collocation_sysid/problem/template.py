"""The commented problem file that `collocation-sysid new` writes."""

from __future__ import annotations

import json
from pathlib import Path

from ..errors import InputError
from ..files import write_whole
from ..folders import require_possible

TEMPLATE = """\
title = {title}

[object]
mesh = "body.vtu"              # tetrahedra, any format meshio reads
# surface = "scan.stl"         # or a closed surface, filled with tetrahedra (extra: surface)
# edge_length_m = 0.02
# length_unit = "mm"           # of the file; "m" by default
mass_kg = 0.1                  # weighed; or density_kg_m3
material = "neo-hookean"       # or stable-neo-hookean, mooney-rivlin, yeoh, gent, ...
element = "tet4"               # or tet10 if it bends or is slender; tet10-p0, poisson above 0.4
# damping = "rayleigh"         # the paper's, which brakes rotation; "kelvin-voigt" by default

# [[object.region]]            # cells that differ; its parameters are "core.young_pa" and so on
# name = "core"
# cells = {{ ball_m = [[0, 0, 0.1], 0.02] }}
# density_kg_m3 = 200.0

# [[object.prony]]             # memory: parameters "prony_1.share" and "prony_1.tau_s", as {{}}
# name = "prony_1"             # one such table a branch; region = "core" if not of all

[parameters]                   # {{}} is estimated, a number alone is fixed
young_pa    = {{}}               # no guess is needed; {{ guess = 1e4, lower = 1e2, upper = 1e6 }}
poisson     = {{ lower = 0.05, upper = 0.45 }}
# density_kg_m3 = {{ guess = 100.0 }}   # with a known force or mass on the body
# lambda_pa and mu_pa, or kappa_pa and mu_pa, may stand in place of young_pa and poisson
gamma_r_s   = {{}}
gamma_m_1_s = {{}}

[[experiment]]                 # one for each recording; all share the parameters
name = "swing"
# kind = "static"              # samples are equilibria, as on a test bench; a motion by default
start = "equilibrium"          # at rest in the grasps that hold then; or "undeformed"
gravity_m_s2 = [0.0, 0.0, -9.81]
# loaded_since_s = 10.0        # with memory: how long at rest; it has relaxed by default
# window_s = [0.5, 2.0]        # use only this span of time
# every = 2                    # and every second sample
# resample_hz = 100.0          # if the markers' times are uneven; poses are always interpolated
# validation = true            # not fitted, only predicted

[experiment.grasp]             # which nodes the gripper holds, and how it moves
nodes = {{ box_m = [[-1, -1, -0.001], [1, 1, 0.001]] }}   # or ball_m, indices, a group's name
poses = "poses.csv"            # t_s,x_m,y_m,z_m,qx,qy,qz,qw: undeformed to current position
# displacement = "crosshead.csv"   # in place of poses: t_s and any of x_m, y_m, z_m
# axes = "z"                   # held along these axes of the world only, as by a sliding platen
# gripper_to_body: position_m and quaternion_xyzw of the body in the gripper, if poses are its
# markers = {{ base1 = [0, 0, 0], base2 = [0.1, 0, 0], base3 = [0, 0.1, 0] }}  # or from tracks
# sigma_m = 0.0003             # noise of each pose, and sigma_rad; judged by their roughness if not
# until_s = 1.2                # let go then; several grasps: a list of such tables

[experiment.markers]
file = "markers.csv"           # t_s,<name>_x,<name>_y,<name>_z,...; or C3D, TRC, Qualisys, Motive
sigma_m = 0.001                # standard deviation of a coordinate
# length_unit = "mm"           # where the file does not say
# labels = {{ "Body:tip" = "tip" }}           # the file's labels, and the names used here
# reference_m = {{ tip = [0.0, 0.0, 0.2] }}   # places on the undeformed body, where they are known
# reference_sigma_m = 0.001    # how well they are; the others' are estimated
# places = "surface"           # places that are estimated stay on the surface; "free" by default

# [experiment.nuisance]        # not known of this recording: the defaults; nuisance = "none" above
# marker_offsets = {{ prior_m = 0.001 }}      # of reference_m without a reference_sigma_m
# time_shift = {{ prior_s = 0.005 }}          # markers against poses; "none" if one clock has both
# gravity = {{ prior_rad = 0.01745 }}         # tilt of its direction
# joining = {{ prior_s = 0.01 }}              # when loads with from_s or until_s join or leave
# hand_eye = {{ prior_rad = 0.0087, prior_m = 0.001 }}   # the body in its grasp
# pose = {{ prior_rad = 0.02, prior_m = 0.002 }}         # cameras off; "none" by default
# camera_offsets = {{ prior_m = 0.001 }}      # of each marker; "none" by default

# [[experiment.mass]]          # a point mass tied to the body
# nodes = {{ box_m = [[-1, -1, 0.19], [1, 1, 0.21]] }}
# mass_kg = 0.05
# from_s = 0.1

# [[experiment.force]]         # a force besides gravity
# nodes = {{ indices = [12, 13] }}
# force_n = [0.0, 0.0, 0.5]    # or file = "force.csv": t_s,fx_n,fy_n,fz_n

# [[experiment.tendon]]        # a tendon through points of the undeformed body, base to end
# points_m = [[0.0, 0.01, 0.2], [0.0, 0.01, 0.1], [0.0, 0.01, 0.0]]
# tension = "tension.csv"      # t_s,tension_n; or tension_n = 3.1

# [[experiment.pressure]]      # a pressure in a cavity
# faces = {{ name = "cavity" }}  # a group of triangles, or {{ ball_m = [[0, 0, 0.1], 0.03] }}
# pressure = "pressure.csv"    # t_s,pressure_pa; or pressure_pa = 5e3

[transcription]
scheme = "midpoint"            # or "bdf2", "backward-euler"
# substeps = 2                 # grid steps between samples; by default what error bars ask for

[solver]
method = "reduced-space"       # or "interior-point", "shooting", ...
# huber = 3.0                  # samples farther off than this many sigmas count linearly

# [solver.reduced-space]       # options of a method: see `collocation-sysid methods reduced-space`
# tolerance = 1e-6

# [uncertainty]
# noise = "given"              # trust sigma_m, whatever the residuals say
# profile = ["poisson"]        # profile likelihood of these parameters

# [rollout]                    # the forward simulation that checks the answer
# timestep_s = 0.002
"""


BENCH = """\
title = {title}

{story}

[object]
{shape}
density_kg_m3 = 1100.0         # of no effect here: there is neither motion nor gravity
material = "neo-hookean"       # or mooney-rivlin, yeoh, gent, ...: compare --materials ranks them
element = "tet10-p0"           # rubber, which would lock linear elements

[parameters]                   # {{}} is estimated, a number alone is fixed
young_pa    = {{}}               # no guess is needed; {{ guess = 1e5, lower = 1e3, upper = 1e7 }}
poisson     = 0.49             # loads hardly tell it
gamma_r_s   = 0.0              # equilibria tell no damping
gamma_m_1_s = 0.0

[experiment_defaults]          # what every [[experiment]] has that does not say it itself
kind = "static"                # each sample is an equilibrium of its own
gravity_m_s2 = [0.0, 0.0, 0.0]
every = 10                     # every tenth row: ten to thirty samples tell what thousands do
# window_s = [2.0, 60.0]       # leave out what is before {contact}
# nuisance = {{ displacement_zero = {{ prior_m = 0.0002 }}, tare = "none" }}   # how zeros are known

[[experiment_defaults.grasp]]  # the lower {ends}, which holds all axes
nodes = {{ box_m = [[-1, -1, -1], [1, 1, 0.0001]] }}

[[experiment_defaults.grasp]]  # the upper one: box_m begins just below the specimen's height
nodes = {{ box_m = [[-1, -1, {below}], [1, 1, 1]] }}
# axes = "z"                   # here and below, where the specimen slides on {ends}s
{columns}

[[experiment_defaults.grasp]]  # the plane of symmetry x = 0, between the {ends}s
nodes = {{ box_m = [[-0.0001, -1, 0.0001], [0.0001, 1, {below}]] }}
axes = "x"

[[experiment_defaults.grasp]]  # the plane of symmetry y = 0
nodes = {{ box_m = [[-1, -0.0001, 0.0001], [1, 0.0001, {below}]] }}
axes = "y"

[[experiment]]                 # one for each run; all share the parameters
name = "run_1"
file = "run_1.csv"             # {file}

# [[experiment]]
# name = "run_2"
# file = "run_2.csv"
# validation = true            # not fitted, only predicted
"""

COMPRESSION = {
    "story": """\
# A cylinder pressed between platens: crosshead and load cell. A quarter is modelled, between its
# planes of symmetry.""",
    "shape": """\
cylinder = { diameter_m = 0.05, height_m = 0.03, quarter = true }   # or mesh = "specimen.vtu"
edge_length_m = 0.011""",
    "contact": "the platen touches all over",
    "ends": "platen",
    "below": "0.0299",
    "columns": """\
displacement = { sign = -1 }   # the file counts downwards as positive; the model's z is upwards
# displacement = { sign = -1, columns = { displacement = "Kanal 1 (mm)" } }   # names of your own
wrench = { sign = -1, symmetry = 4, sigma_n = 0.1 }   # a quarter of the load, its noise too""",
    "file": "Time (s),Displacement (mm),Force (N); what machines write above is left out",
}

TENSION = {
    "story": """\
# A bar pulled between clamps: engineering strain and stress. A quarter is modelled, between its
# planes of symmetry: half as wide and half as thick.""",
    "shape": """\
box_m = [0.008, 0.008, 0.02]   # half the width, half the thickness, the length between the clamps
edge_length_m = 0.004          # or mesh = "specimen.vtu" in place of both""",
    "contact": "the bar is straight",
    "ends": "clamp",
    "below": "0.0199",
    "columns": """\
displacement = { length_m = 0.02 }   # what strain multiplies; {} where the file has an extension
# displacement = { length_m = 0.02, columns = { strain = "Kanal 1 (%)" } }    # names of your own
wrench = { area_m2 = 2.56e-4, symmetry = 4, sigma_n = 0.02 }   # of the whole bar""",
    "file": "Time (s),Strain (%),Stress (kPa); what machines write above is left out",
}

# What each kind of problem is written from.
KINDS = {
    "swing": (TEMPLATE, {}),
    "compression": (BENCH, COMPRESSION),
    "tension": (BENCH, TENSION),
}


def write_template(folder: Path, kind: str = "swing") -> Path:
    """Write problem.toml of a kind into a folder, which is made; its name is the title.

    Raises
    ------
    InputError
        Where there is one already, or the folder cannot be made.
    """
    file = folder / "problem.toml"
    require_possible(folder)
    if file.exists():
        raise InputError("it is there already; choose another name", file)
    title = json.dumps(folder.resolve().name, ensure_ascii=False)  # quoted as TOML quotes
    text, words = KINDS[kind]
    write_whole(file, text.format(title=title, **words))
    return file
