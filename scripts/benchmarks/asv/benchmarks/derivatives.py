"""Matrices of the collocation program, and of a step in contact."""

from __future__ import annotations

from benchmark_contact import FRICTION_BY_CASE, make_timed_functions
from benchmark_jacobian import PROBLEM, measure

from collocation_sysid.problem import Problem
from collocation_sysid.program.sweep import Sweep


class Assembly:
    """Nonlinear program of the size of Table I."""

    def setup_cache(self) -> dict:
        """Return the median times of both evaluators, measured in one run."""
        return measure(PROBLEM, "backward-euler", 7)

    def track_jacobian_ms(self, medians: dict) -> float:
        """Return the time of the compiled Jacobian on one thread [ms]."""
        return medians["jacobian"]["simd_1_ms"]

    def track_ratio_to_casadi_map(self, medians: dict) -> float:
        """Return the time of the Jacobian by casadi.Function.map, divided by that of the compiled
        kernels.
        """
        return medians["jacobian"]["casadi_map_ms"] / medians["jacobian"]["simd_1_ms"]


class Contact:
    """Pressed cube with and without friction, and the same cube without contact."""

    params = tuple(FRICTION_BY_CASE)
    param_names = ("contact",)

    def setup(self, case: str) -> None:
        """Make the body and its motion."""
        self.functions = make_timed_functions(4, 12, FRICTION_BY_CASE[case])

    def time_sweep(self, case: str) -> None:
        """Time a sweep: the sensitivities along the motion, with their factorisations."""
        self.functions["sweep"]()

    def time_forward_simulation(self, case: str) -> None:
        """Time a forward simulation by Newton's method."""
        self.functions["forward simulation"]()


class Sensitivities:
    """Sensitivities of the shipped recording."""

    def setup(self) -> None:
        """Evaluate the first experiment at the guess, with the body moving rigidly."""
        collocation = Problem.read(PROBLEM).collocation()
        shapes = [s.experiment.rigid_positions(s.dynamics.t_s) for s in collocation.transcriptions]
        z = collocation.pack(collocation.parameters.guess_q, shapes)
        self.part = next(iter(collocation.iterates(z)))

    def time_sweep(self) -> None:
        """Time a forward sweep with the columns of all parameters."""
        Sweep(self.part.transcription).forward(self.part.x, self.part.equations)

    def peakmem_sweep(self) -> None:
        """Measure the peak memory of the sweep that `time_sweep` times."""
        Sweep(self.part.transcription).forward(self.part.x, self.part.equations)
