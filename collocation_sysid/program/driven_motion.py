"""Motion of one experiment as a function of what drives it: the prescribed positions of its grasped
dofs, and the amplitudes of its tendons and pressures.

Methods that choose these, instead of reading them from a recording, need the motion of the body and
its derivatives by their controls. The parameters q are fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..errors import SimulationError
from ..fem.schemes import Scheme
from ..model.equations_at_parameters import EquationsAtParameters
from ..model.grasp_constraint import PrescribedDisplacements
from ..model.inputs import Inputs
from ..model.parameters import Parameters
from ..recording.experiment import Experiment
from .collocation import Collocation
from .forward.newton_solver import NewtonOptions
from .forward.scheme_simulation import continue_simulation
from .linear_algebra.lapack import one_blas_thread
from .sweep import ForwardSubstitution, PrescribedColumns, Sweep, SweepColumns
from .transcription import Transcription

# Largest residual of the equations of motion of a corrected motion, over the unit of forces.
CORRECTED = 1e-11
# Most corrections of a motion by one forward sweep each, before it is simulated anew.
MOST_CORRECTIONS = 4


@dataclass(frozen=True, eq=False)
class Drive:
    """Prescribed positions, and amplitudes of tendons and pressures, that drive a motion, with their
    derivatives by controls.

    Attributes
    ----------
    goals_m : (N, g) array
        Prescribed positions of the grasped dofs at the grid times [m].
    by_control : (N, g, c) array
        Their derivatives by the c controls; empty, c = 0, where none are needed.
    amplitudes : (N, a) array, optional
        Amplitudes of the energies of all tendons, then pressures, at the evaluations of the forces;
        those of the experiment by default.
    amplitudes_by_control : (N, a, c) array, optional
        Their derivatives by the controls; zero by default.
    """

    goals_m: Array
    by_control: Array
    amplitudes: Array | None = None
    amplitudes_by_control: Array | None = None

    @property
    def without_controls(self) -> Drive:
        """The same drive without derivatives."""
        return Drive(self.goals_m, self.by_control[..., :0], self.amplitudes)


@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """Motion of one experiment as a function of a `Drive`, at fixed parameters.

    Attributes
    ----------
    collocation : Collocation
        Program of one experiment without nuisance parameters, in which all prescribed displacements
        are constraints.
    q : (nq,) array
        Parameters in the solver's coordinates.
    """

    collocation: Collocation
    q: Array

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        parameters: Parameters,
        scheme: str | Scheme,
        substeps: int,
        q: Array,
    ) -> DrivenMotion:
        """Discretise an experiment; all prescribed displacements become constraints of the
        collocation program.

        Parameters
        ----------
        experiment : Experiment
            Experiment whose `nuisance` has no deviations.
        parameters : Parameters
            Shared parameters, with guesses.
        scheme : str or Scheme
            Time discretisation.
        substeps : int
            Time steps between samples.
        q : (nq,) array
            Parameters in the solver's coordinates.
        """
        program = Collocation(
            [experiment], parameters, scheme=scheme, substeps=substeps, has_grasp_constraints=True
        )
        return cls(program, q)

    @property
    def transcription(self) -> Transcription:
        """Discretised experiment."""
        return self.collocation.transcriptions[0]

    @property
    def theta(self) -> Array:
        """Constants θ of the body."""
        return self.transcription.constants.theta(self.q)

    @property
    def t_s(self) -> Array:
        """Grid times (N,) [s]."""
        return self.transcription.dynamics.t_s

    @property
    def dofs(self) -> Index:
        """Grasped dofs (g,), ascending."""
        return self.transcription.prescribed_motion.dofs

    @cached_property
    def _stated(self) -> EquationsAtParameters:
        return self.transcription.equations_at(self.q, self.transcription.guess_phi)

    @property
    def stated_goals_m(self) -> Array:
        """Prescribed positions (N, g) of the grasped dofs as the experiment states them [m]."""
        return self._stated.prescribed.positions_m

    @property
    def _amplitude_columns(self) -> slice:
        """Columns of the amplitudes in u, after the constants."""
        first = len(self.transcription.body.constants)
        return slice(first, first + len(self.transcription.experiment.actuators))

    @property
    def stated_amplitudes(self) -> Array:
        """Amplitudes (N, a) of tendons and pressures at the evaluations, as the experiment states
        them.
        """
        return self._stated.inputs.evaluate_at(self._stated.p)[0][:, self._amplitude_columns]

    @property
    def evaluated_s(self) -> Array:
        """Times (N,) of the evaluations of the forces [s]."""
        return self.transcription.dynamics.evaluated_s

    @cached_property
    def _sweep(self) -> Sweep:
        return Sweep(self.transcription)

    def equations(self, drive: Drive) -> EquationsAtParameters:
        """Return the equations of motion under a drive; the derivatives are by the controls in
        place of the parameters.
        """
        stated = self._stated
        u, _ = stated.inputs.evaluate_at(stated.p)
        controls = drive.by_control.shape[2]
        by_control = np.broadcast_to(0.0, (*u.shape, controls))
        dynamics = stated.dynamics
        if drive.amplitudes is not None:
            u = np.array(u)
            u[:, self._amplitude_columns] = drive.amplitudes
            dynamics = dynamics.with_inputs(u)
        if drive.amplitudes_by_control is not None:
            by_control = np.zeros(by_control.shape)
            by_control[:, self._amplitude_columns] = drive.amplitudes_by_control
        goals = np.full((len(self.t_s), self.transcription.dof_count), np.nan)
        goals[:, self.dofs] = drive.goals_m
        return replace(
            stated,
            # Linear in the controls: without second derivatives.
            inputs=Inputs((), controls, len(self.t_s)),
            nq=0,
            input_derivatives=by_control,
            dynamics=replace(dynamics, prescribed_m=goals),
            prescribed=PrescribedDisplacements(self.dofs, drive.goals_m, by_phi=drive.by_control),
        )

    def simulate(
        self, drive: Drive, start: Array | None = None, near: Array | None = None
    ) -> Array:
        """Return the positions (N, 3n) [m] of the motion under a drive.

        Parameters
        ----------
        start : (3n,) array, optional
            Positions at the first time, where they are known from another drive that begins in the
            same way.
        near : (N, 3n) array, optional
            Motion under a similar drive, corrected to first order: it is corrected further by
            forward sweeps, which take less time than a simulation.

        Raises
        ------
        SimulationError
            If a time step fails.
        """
        equations = self.equations(drive.without_controls)
        if near is not None:
            corrected = self._corrected(equations, near)
            if corrected is not None:
                return corrected
        x, failure = continue_simulation(
            self.transcription.experiment,
            equations.dynamics,
            known=None if start is None else start[None],
            options=NewtonOptions(),
        )
        if failure is not None:
            raise failure
        return x

    def _corrected(self, equations: EquationsAtParameters, near: Array) -> Array | None:
        """Return the motion from Newton on all steps at once; None if slow."""
        goals = equations.dynamics.prescribed_m
        x = np.where(np.isnan(goals), near, goals)
        previous = np.inf
        for _ in range(MOST_CORRECTIONS):
            try:
                with np.errstate(all="ignore"):
                    step, _, violation = self._respond(equations, x)
            except SimulationError:
                return None
            if not np.isfinite(violation) or violation > 0.5 * previous:
                return None
            x = x + step
            size = float(np.abs(step).max())
            if violation <= CORRECTED * self.transcription.stiffness_n or (
                size <= 1e-12 * self.transcription.length_m
            ):
                return x
            previous = violation
            # The next step is the square of this one, relative to the elements.
            if size < 1e-6 * self.transcription.length_m:
                return x
        return None

    def respond(self, drive: Drive, x: Array) -> Array:
        """Return the derivatives (N, 3n, c) of a motion x (N, 3n) [m] by the controls."""
        return self._respond(self.equations(drive), x)[1]

    @one_blas_thread()
    def _respond(self, equations: EquationsAtParameters, x: Array) -> tuple[Array, Array, float]:
        """Return feasibility step, derivatives (N, 3n, c), largest residual [N]."""
        sweep = self._sweep
        goals = equations.prescribed.positions_m
        by_control = equations.prescribed.by_phi
        changes = np.concatenate([np.zeros((*goals.shape, 1)), by_control], axis=2)
        changes[..., 0] = np.nan_to_num(goals - x[:, self.dofs])
        columns = SweepColumns(
            equations,
            changes.shape[2],
            has_step=True,
            prescribed=PrescribedColumns.from_columns(sweep, self.dofs, columns=changes),
        )
        out = np.zeros((*x.shape, changes.shape[2]))
        march = ForwardSubstitution(sweep, columns)
        for t, _ in enumerate(march.iterate_rows(x, out=out)):
            if t < sweep.dynamics.first_row:
                out[t] = march.past[0]
        return out[..., 0], out[..., 1:], march.violation_n
