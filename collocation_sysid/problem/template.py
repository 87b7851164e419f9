"""The commented problem file that `collocation-sysid new` writes."""

TEMPLATE = """\
title = {title}

[object]
mesh = "body.vtu"              # tetrahedra, any format meshio reads
# surface = "scan.stl"         # or a closed surface, filled with tetrahedra (extra: surface)
# edge_length_m = 0.02
# length_unit = "mm"           # of the file; "m" by default
mass_kg = 0.1                  # weighed; or density_kg_m3
material = "neo-hookean"       # or st-venant-kirchhoff, mooney-rivlin, stable-neo-hookean, linear
element = "tet4"               # or tet10, for bending, a slender body, or poisson above 0.4

[parameters]                   # estimated from a guess within bounds, or {{ fixed = 0.5 }}
young_pa    = {{ guess = 1e4, lower = 1e2, upper = 1e6 }}
poisson     = {{ guess = 0.3, lower = 0.05, upper = 0.45 }}
# lambda_pa and mu_pa may stand in place of young_pa and poisson
gamma_r_s   = {{ guess = 0.01, lower = 1e-5, upper = 1.0 }}
gamma_m_1_s = {{ guess = 1.0, lower = 1e-3, upper = 100.0 }}

[[experiment]]
name = "swing"
start = "equilibrium"          # at rest in the grasp; or "undeformed": released at the first time
gravity_m_s2 = [0.0, 0.0, -9.81]
# window_s = [0.5, 2.0]        # use only this span of time
# resample_hz = 100.0          # if poses and markers have different rates
# validation = true            # not fitted, only predicted

[experiment.grasp]             # which nodes the gripper holds, and how it moves
nodes = {{ box_m = [[-1, -1, -0.001], [1, 1, 0.001]] }}   # or ball_m, indices, a point array's name
poses = "poses.csv"            # t_s,x_m,y_m,z_m,qx,qy,qz,qw: undeformed to current position

[experiment.markers]
file = "markers.csv"           # t_s,<name>_x,<name>_y,<name>_z,...; blank or NaN is missing
sigma_m = 0.001                # standard deviation of a coordinate
# length_unit = "mm"
# reference_m = {{ tip = [0.0, 0.0, 0.2] }}   # places on the undeformed body, where they are known

[transcription]
scheme = "midpoint"            # or "bdf2", "backward-euler"
substeps = 1                   # grid steps between samples

[solver]
method = "reduced-space"       # or "interior-point", which needs no simulable guess

# [rollout]                    # the forward simulation that checks the answer
# timestep_s = 0.002
"""
