"""What is done to a body and measured on it: grasps, markers, files, and the experiment."""

from .alignment import align
from .clock import sample_interval_s
from .experiment import Experiment
from .grasp import Grasp, PoseSequence, held_nodes
from .markers import Markers, Placement, place_markers
from .readers import (
    MarkerTable,
    read_markers_csv,
    read_poses_csv,
    write_markers_csv,
    write_poses_csv,
)

__all__ = [
    "Experiment",
    "Grasp",
    "MarkerTable",
    "Markers",
    "Placement",
    "PoseSequence",
    "align",
    "held_nodes",
    "place_markers",
    "read_markers_csv",
    "read_poses_csv",
    "sample_interval_s",
    "write_markers_csv",
    "write_poses_csv",
]
