"""What is done to a body and measured on it: grasps, markers, files, and the experiment."""

from .alignment import Aligned, align
from .clock import sample_interval_s
from .experiment import Experiment
from .gauge import Gauge, Look
from .grasp import Grasp, held_dofs, held_nodes
from .loads import Force, PointMass
from .markers import Markers, Placement, place_markers
from .nuisance import Nuisance, NuisanceRow
from .pose_files import read_poses
from .poses import PoseSequence
from .pressure import Pressure
from .readers import MarkerTable, read_markers
from .rigid import RigidFit, TemplateFit, align_to_template, fit_poses
from .tables import (
    displaced_axes,
    read_displacement,
    read_forces,
    read_pressure,
    read_tension,
    read_wrench,
)
from .tendon import Tendon
from .wrench import Wrench
from .writers import write_gauge_csv, write_markers_csv, write_poses_csv, write_wrench_csv

__all__ = [
    "Aligned",
    "Experiment",
    "Force",
    "Gauge",
    "Grasp",
    "Look",
    "MarkerTable",
    "Markers",
    "Nuisance",
    "NuisanceRow",
    "Placement",
    "PointMass",
    "PoseSequence",
    "Pressure",
    "RigidFit",
    "TemplateFit",
    "Tendon",
    "Wrench",
    "align",
    "align_to_template",
    "displaced_axes",
    "fit_poses",
    "held_dofs",
    "held_nodes",
    "place_markers",
    "read_displacement",
    "read_forces",
    "read_markers",
    "read_poses",
    "read_pressure",
    "read_tension",
    "read_wrench",
    "sample_interval_s",
    "write_gauge_csv",
    "write_markers_csv",
    "write_poses_csv",
    "write_wrench_csv",
]
