"""Forces and torques of grasps with a sensor.

- `reaction_forces`: residual of the equations of motion at the prescribed dofs.
- `wrench_observable`: the wrench of a grasp as an observable; `wrench_residual`: its residual.
- `grasp_reactions`: reactions along a recording that arrives frame by frame.
"""
