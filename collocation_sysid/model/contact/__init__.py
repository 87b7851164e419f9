"""Contact between a deformable body and rigid obstacles.

- `contact_law`: pressure and friction at a point of the surface.
- `contact_force`: the contact force of an obstacle as a term of the equations of motion.
- `step_contact`: contact in one time step, at the points that may touch.
- `contact_summary`: contact of a motion in numbers.
"""
