"""Matrices of the collocation program, and of a step in contact."""

from __future__ import annotations

from benchmark_contact import CASES, prepared
from benchmark_jacobian import PROBLEM, measure

from collocation_sysid.problem import Problem
from collocation_sysid.program.sweep import Sweep


class Assembly:
    """The program of Table I's size."""

    def setup_cache(self) -> dict:
        """Medians of both evaluators, in one run."""
        return measure(PROBLEM, "backward-euler", 7)

    def track_jacobian_ms(self, measured: dict) -> float:
        """Time of the compiled Jacobian on one thread [ms]."""
        return measured["jacobian"]["simd_1_ms"]

    def track_ratio_to_casadi_map(self, measured: dict) -> float:
        """Time of the Jacobian by casadi.Function.map, divided by that of the compiled kernels."""
        return (
            measured["jacobian"]["casadi_map_ms"]
            / measured["jacobian"]["simd_1_ms"]
        )


class Contact:
    """A block that is pressed, with and without friction, and the same without contact."""

    params = tuple(CASES)
    param_names = ("contact",)

    def setup(self, case: str) -> None:
        """Make the body and its motion."""
        self.works = prepared(4, 12, CASES[case])

    def time_sweep(self, case: str) -> None:
        """Time a sweep: the sensitivities along the motion, with their factorisations."""
        self.works["sweep"]()

    def time_forward_simulation(self, case: str) -> None:
        """Newton's method, step by step."""
        self.works["forward simulation"]()


class Sensitivities:
    """Sensitivities of the shipped recording."""

    def setup(self) -> None:
        """Evaluate the first experiment at the guess, with the body moving rigidly."""
        collocation = Problem.read(PROBLEM).collocation()
        shapes = [
            s.experiment.rigid_positions(s.dynamics.t_s)
            for s in collocation.transcriptions
        ]
        z = collocation.pack(collocation.parameters.guess_q, shapes)
        self.part = next(iter(collocation.iterates(z)))

    def time_sweep(self) -> None:
        """Time a forward sweep with the columns of all parameters."""
        Sweep(self.part.segment).forward(self.part.x, self.part.equations)

    def peakmem_sweep(self) -> None:
        """Measure the peak memory of the sweep that `time_sweep` times."""
        Sweep(self.part.segment).forward(self.part.x, self.part.equations)
