"""The nonlinear program: experiments transcribed in time, their measurements, and how they are
solved.

Transcription
    `collocation` is the whole program (objective, constraints, derivatives) of several experiments.
    `segment` is one experiment of it, `part` one experiment at given variables, `sharing` the
    nuisance parameters that experiments have in common. `motion_rows`, `block_band` and `entries`
    lay out the sparse Jacobian and Hessian, `local_loss` the Hessian of the loss.
Lifted variables
    `carried` is the base class of variables that are eliminated by default and can be added with
    equations of their own; `explicit` adds them. `viscoelastic_rows` (material memory),
    `force_rows` (force histories), `pressure_rows` (complementarity), `reaction_rows` and
    `wrench_rows` (measured forces) are the kinds; `pattern_rows` assembles repeated small
    expressions.
Measurements
    `channel` and `wrench_channel` are the observables, `sensing` evaluates them along a motion, and
    `reading` compares them with data. `markers`, `wrench`, `gauge` (custom sensors), `depth` and
    `outline_reading` are the kinds of measurement. `charts` associates markers with elements.
    `view`, `skin`, `sighting`, `outline`, `camera_alignment` and `depth_comparison` model depth
    cameras.
Linear algebra
    `sweep` solves the linearised equations of motion forward and backward in time, `factorisation`
    factorises one time step (with `lapack` and `supernodal`), `least_squares_of_fit` accumulates
    normal
    equations in square-root form, `stopwatch` measures time.
Simulation
    `simulation` simulates an experiment by `marching` (collocation schemes) or `simulate_newmark`,
    with
    Newton's method of `newton`, `retraction` and `near_contact`, from the equilibrium of `rest`.
Analyses of a motion
    `reaction` (reaction forces), `modes` (natural modes), `stability` and `find_lost_stability`,
    `contact_summaries` (contact), `any_stiffness` (rough predictions while the stiffness is
    unknown).

Methods use `Collocation`; statistics use `Transcription`, `ExperimentIterate` and `Sweep`;
predictions use `simulate`.
"""
