"""Contact during a motion; the contact law is `model.contact`.

- `step_contact`: contact forces of one time step, at the points that may touch.
- `condensed_contact`: solution of a time step with the contact condensed to the dofs that touch.
- `contact_summary`: contact of a solved motion in numbers.
"""
