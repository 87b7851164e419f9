"""Recordings: what was done to a body and what was measured on it.

Begin with `experiment` (one recording with all its parts). Its parts are in:

- `grasp`, `poses`, `wrench`: prescribed displacements, the rigid motions that prescribe them, and
measured reaction forces.
- `obstacle`, `solids`: rigid obstacles for contact, and their shapes.
- `loads`, `tendon`, `pressure`, `actuator`: point masses, forces, tendons and pressures.
- `markers`, `placement`: tracked markers and where they sit on the body.
- `depth`: depth cameras and scanners.
- `gauge`: custom sensors.
- `nuisance`: unknowns of a single recording, with their priors.
- `environment`: the density of the air.

Files are read by `readers` (markers), `pose_files` (poses), `tables` (forces, displacements,
pressures, custom sensors) and the subpackage `formats`; `writers` writes them. `align_camera`,
`clock_hypothesis`
and `rigid` prepare data: one time grid, sample times, rigid fits. `refinement` moves an experiment
to a finer mesh, `turning` finds the fastest rotation of its grasps, and `arrays` and `selected`
check arrays and node selections.
"""

from .alignment import align as align
from .clock import sample_interval_s as sample_interval_s
from .depth import Depth as Depth
from .depth import DepthCamera as DepthCamera
from .depth import depth_image as depth_image
from .experiment import Experiment as Experiment
from .gauge import Gauge as Gauge
from .gauge import Look as Look
from .grasp import Grasp as Grasp
from .grasp import prescribed_dofs as prescribed_dofs
from .grasp import prescribed_nodes as prescribed_nodes
from .loads import Force as Force
from .loads import PointMass as PointMass
from .markers import Markers as Markers
from .markers import Placement as Placement
from .markers import place_markers as place_markers
from .nuisance import Nuisance as Nuisance
from .nuisance import NuisanceRow as NuisanceRow
from .obstacle import Obstacle as Obstacle
from .pose_files import read_poses as read_poses
from .poses import PoseSequence as PoseSequence
from .pressure import Pressure as Pressure
from .readers import MarkerTable as MarkerTable
from .readers import read_markers as read_markers
from .rigid import align_to_template as align_to_template
from .rigid import fit_poses as fit_poses
from .solids import Capsule as Capsule
from .solids import Cuboid as Cuboid
from .solids import Cylinder as Cylinder
from .solids import Plane as Plane
from .solids import Solid as Solid
from .solids import Sphere as Sphere
from .tables import displaced_axes as displaced_axes
from .tables import read_displacement as read_displacement
from .tables import read_wrench as read_wrench
from .tendon import Tendon as Tendon
from .wrench import Wrench as Wrench
from .writers import write_gauge_csv as write_gauge_csv
from .writers import write_markers_csv as write_markers_csv
from .writers import write_poses_csv as write_poses_csv
from .writers import write_wrench_csv as write_wrench_csv
