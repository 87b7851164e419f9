"""Forces and torques of grasps with a sensor.

- `wrench_observable`: the wrench of a grasp as an observable; `wrench_residual`: its residual.
- `grasp_reactions`: reactions along a recording that arrives frame by frame.
"""
