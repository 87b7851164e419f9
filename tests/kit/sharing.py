"""Recordings that share nuisance parameters."""

from __future__ import annotations

from dataclasses import replace

from collocation_sysid.recording import Experiment
from kit.problems import smooth_poses


def sharing(experiment: Experiment, *names: str, word: str = "shared") -> Experiment:
    scope = dict.fromkeys(names, word)
    return replace(experiment, nuisance=replace(experiment.nuisance, scope=scope))


def swung_again(experiment: Experiment, name: str) -> Experiment:
    """The same body with the same markers, on another day."""
    (grasp,) = experiment.grasps
    poses = smooth_poses(experiment.t_s, (-0.01, 0.02, 0.01), (0.1, 0.25, -0.1))
    return replace(experiment, grasps=[replace(grasp, poses=poses)], name=name)
