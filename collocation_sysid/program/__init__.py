"""The nonlinear program: experiments transcribed in time, their measurements, and how they are
solved.

Transcription
    `collocation` is the whole program (objective, constraints, derivatives) of several experiments.
    `transcription` is one experiment of it, `experiment_iterate` one experiment at given variables,
    `shared_nuisances` the nuisance parameters that experiments have in common. `motion_jacobian`,
    `block_band` and `sparse_assembly` lay out the sparse Jacobian and Hessian, `local_loss` the
    Hessian of the loss.
Lifted variables
    `lifted_variables` is the base class of variables that are eliminated by default and can be
    added with equations of their own; `lifting` adds them. `lifted_memory` (material memory),
    `lifted_force_histories` (force histories), `lifted_contact_pressures` (complementarity),
    `lifted_reactions` and `lifted_wrenches` (measured forces) are the kinds; `expression_patterns`
    assembles repeated small expressions.
Measurements
    `observables` and `wrench_observable` are the observables, `observation` evaluates them along a
    motion, and `measurement_residual` compares them with data. `marker_residual`,
    `wrench_residual`, `custom_sensor_residual` (custom sensors), `depth_residual` and
    `outline_residual` are the kinds of measurement. `marker_association` associates markers with
    elements. `depth_camera_model`, `visible_surface`, `surface_correspondences`, `depth_outline`,
    `camera_alignment` and `depth_comparison` model depth cameras.
Linear algebra
    `sweep` solves the linearised equations of motion forward and backward in time, `factorisation`
    factorises one time step (with `lapack` and `supernodal`), `least_squares` accumulates normal
    equations in square-root form, `stopwatch` measures time.
Streaming
    `streaming` is the interface of time marching along a recording that arrives frame by frame:
    `streaming_model` is its program, `streaming_sweep` marches with sensitivities, and
    `grasp_reactions` are the reaction forces of grasps with a sensor.
Simulation
    `simulation` simulates an experiment by `scheme_simulation` (collocation schemes) or `newmark`,
    with Newton's method of `newton_solver`, `retraction` and `step_contact`, from the equilibrium
    of `initial_equilibrium`.
Analyses of a motion
    `reaction_forces` (reaction forces), `natural_modes` (natural modes), `stability` and
    `loss_of_stability`, `contact_summary` (contact), `modal_prediction` (rough predictions
    while the stiffness is unknown).

Methods use `Collocation`; statistics use `Transcription`, `ExperimentIterate` and `Sweep`;
predictions use `simulate`; live estimation uses `streaming`.
"""
