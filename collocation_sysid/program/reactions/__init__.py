"""Reactions of grasps: forces that prescribed displacements exert on the body.

- `reaction_forces`: reaction forces of nodes, with derivatives along the equations of motion.
- `reaction_resultant`: their resultant force and torque at a sensor, as an observable.
- `grasp_reactions`: reactions along a recording that arrives frame by frame.
"""
