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
substeps = 1                   # grid steps between samples

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


def write_template(folder: Path) -> Path:
    """Write problem.toml into a folder, which is made; its name is the title.

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
    write_whole(file, TEMPLATE.format(title=title))
    return file
