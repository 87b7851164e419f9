"""Contact between a deformable body and rigid obstacles.

- `law`: pressure and friction at a point of the surface.
- `force`: the contact force of an obstacle as a term of the equations of motion.
- `time_step`: contact in one time step, at the points that may touch.
- `summary`: contact of a motion in numbers.
"""
