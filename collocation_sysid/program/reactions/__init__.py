"""Reactions of grasps: forces that prescribed displacements exert on the body.

- `forces`: reaction forces of nodes, with derivatives along the equations of motion.
- `resultant`: their resultant force and torque at a sensor, as an observable.
"""
