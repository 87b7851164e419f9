"""The nonlinear program: experiments transcribed in time, their measurements, and how they are
solved.

Transcription
    `collocation` is the whole program (objective, constraints, derivatives) of several experiments.
    `transcription` is one experiment of it, of which `motion_transcription` is the part without
    measurements; `association` states where on the body and in time these are evaluated, and
    `experiment_iterate` is one experiment at given variables. `motion_jacobian` lays out the
    sparse Jacobian, and `lifted` the program in which variables that are otherwise eliminated have
    equations of their own.
Measurements
    `observables` are measurable quantities, `observable_response` linearises them along the
    equations of motion, and `measurement_residual` compares them with data. A `measurement_model`
    makes the residuals of one measurement, and `measurement_models` is the table of kinds:
    force–torque sensors in `wrench_residual`, custom sensors in `custom_sensor_residual` and
    `following_sensor`, others in packages of their own. `correspondences` is the interface of
    those that refer to points which follow the estimates. The package `reactions` contains the
    reactions of grasps.
Linear algebra
    `sweep` solves the linearised equations of motion forward and backward in time,
    `least_squares` accumulates normal equations in square-root form, `stopwatch` measures time, and
    the package `linear_algebra` factorises one time step.
Simulation
    `simulation` simulates an experiment with the package `forward`.
Analyses of a motion
    The package `modes`.

Methods use `Collocation`; statistics use `Transcription`, `ExperimentIterate` and `Sweep`;
predictions use `simulate`.
"""
