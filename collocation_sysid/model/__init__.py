"""Equations of motion of a deformable body, with derivatives with respect to all parameters.

From parameters to inputs of the equations:

- `parameters`: shared parameters of a problem, with bounds, priors and the solver's coordinates q.
- `nuisance_map`: nuisance parameters φ of one recording.
- `inputs`: the vector u(q, φ; t) by which both enter the equations of motion.

Forces:

- `forces`: sum of all forces on a body; start here.
- `force_term`: interface of a force, and forces that have an energy.
- `weight`: gravity, masses and loads.
- `contact`: pressure and friction of rigid obstacles.
- `local_force`: forces on few, changing points within one time step.
- `point_forces`: custom forces and air drag.
- `generated_functions`: small expressions with generated derivatives.

Internal (history) variables:

- `viscoelasticity`: memory of the material.
- `force_internal_variables`: internal variables of forces.
- `internal_variables`: both of them along one motion.
- `recursion`: recursions h_k = R(h_{k−1}, …) of sensors and memories.

Equations in discrete time:

- `schemes`: tables of the time-stepping schemes.
- `dynamics`: discrete equations of motion of an experiment.
- `equations_at_parameters`: these equations at given parameters, with the chain rule.
- `grasp_constraint`: prescribed displacements of grasped nodes, as a function of φ.
"""
