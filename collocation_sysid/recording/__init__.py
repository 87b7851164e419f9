"""Recordings: what was done to a body and what was measured on it.

Begin with `experiment` (one recording with all its parts). Its parts are in:

- `grasp`, `poses`, `measured_wrench`: prescribed displacements, the rigid motions that prescribe
  them, and measured reaction forces.
- `obstacle`, `obstacle_solids`: rigid obstacles, their shapes, and the tables that state them.
- `loads`, `tendon`, `pressure`, `actuator`: point masses, forces, tendons and pressures.
- `markers`, `placement`: tracked markers and where they sit on the body.
- `camera`: lenses and poses of cameras; `depth_camera`: depth cameras and scanners.
- `custom_sensor`: custom sensors.
- `measurement`: what all measurements have in common.
- `nuisance`: unknowns of a single recording, with their priors.
- `specimen`, `specimen_stretches`, `homogeneous_deformation`: material tests without a mesh;
  `specimen_files` reads their tables, and `specimen_checks` finds mistakes and cycles in them.

Files are read by `marker_files` (markers), `pose_files` (poses), `time_tables` (forces,
displacements, pressures, custom sensors) and the subpackage `sources`; `writers` writes
them. `alignment`, `sample_times`, `gap_interpolation` and `rigid_fit` prepare data:
one time grid with lost or jittered frames, sample times, interpolation between consecutive
samples, rigid fits. `experiment_refinement` and
`experiment_coarsening` move an experiment to a finer or coarser mesh by `experiment_on_body`,
`measurement_selection` copies it with a
part of its measurements, and `node_selection` checks selections of nodes.
"""

from .alignment import align as align
from .camera import Camera as Camera
from .custom_sensor import CustomSensor as CustomSensor
from .custom_sensor import FollowingSensor as FollowingSensor
from .custom_sensor import Gauge as Gauge
from .custom_sensor import GraspQuantities as GraspQuantities
from .custom_sensor import PointQuantities as PointQuantities
from .depth_camera import Depth as Depth
from .depth_camera import DepthCamera as DepthCamera
from .depth_camera import depth_image as depth_image
from .deviation import Deviation as Deviation
from .deviation import NuisanceRow as NuisanceRow
from .experiment import Experiment as Experiment
from .grasp import Grasp as Grasp
from .grasp import prescribed_dofs as prescribed_dofs
from .grasp import prescribed_nodes as prescribed_nodes
from .loads import Force as Force
from .loads import PointMass as PointMass
from .marker_files import MarkerTable as MarkerTable
from .marker_files import read_markers as read_markers
from .markers import Markers as Markers
from .markers import Placement as Placement
from .markers import place_markers as place_markers
from .measured_wrench import Wrench as Wrench
from .measured_wrench import read_wrench as read_wrench
from .measured_wrench import write_wrench_csv as write_wrench_csv
from .nuisance import Nuisance as Nuisance
from .obstacle import Obstacle as Obstacle
from .obstacle_solids import Capsule as Capsule
from .obstacle_solids import Cuboid as Cuboid
from .obstacle_solids import Cylinder as Cylinder
from .obstacle_solids import Plane as Plane
from .obstacle_solids import Solid as Solid
from .obstacle_solids import Sphere as Sphere
from .pose_files import read_poses as read_poses
from .poses import PoseSequence as PoseSequence
from .pressure import Pressure as Pressure
from .rigid_fit import align_to_template as align_to_template
from .rigid_fit import fit_poses as fit_poses
from .sample_times import sample_interval_s as sample_interval_s
from .specimen import Specimen as Specimen
from .tendon import Tendon as Tendon
from .time_tables import displaced_axes as displaced_axes
from .time_tables import read_displacement as read_displacement
from .writers import write_gauge_csv as write_gauge_csv
from .writers import write_markers_csv as write_markers_csv
from .writers import write_poses_csv as write_poses_csv
