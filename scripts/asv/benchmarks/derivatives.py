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
        """Compiled, on one thread."""
        return measured["jacobian"]["simd_1_ms"]

    def track_ratio_to_casadi_map(self, measured: dict) -> float:
        """How many times longer the same expressions take through casadi.Function.map."""
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
        """Sensitivities along the motion."""
        self.works["sweep"]()

    def time_forward_simulation(self, case: str) -> None:
        """Newton's method, step by step."""
        self.works["forward simulation"]()


class Sensitivities:
    """Sensitivities of the shipped recording."""

    def setup(self) -> None:
        """Start at the guess."""
        collocation = Problem.read(PROBLEM).collocation()
        shapes = [
            s.experiment.rigid_positions(s.dynamics.t_s)
            for s in collocation.transcriptions
        ]
        z = collocation.pack(collocation.parameters.guess_q, shapes)
        self.part = next(iter(collocation.iterates(z)))

    def time_sweep(self) -> None:
        """Forward, all columns."""
        Sweep(self.part.segment).forward(self.part.x, self.part.equations)

    def peakmem_sweep(self) -> None:
        """The same."""
        Sweep(self.part.segment).forward(self.part.x, self.part.equations)
