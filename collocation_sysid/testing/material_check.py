"""Check of a strain-energy density: `check_material`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import Positive
from ..fem.laws.materials import Energy, Material, as_material
from .property_check import PropertyCheck
from .small_problems import usual_constants

# Number of random deformations.
DEFORMATIONS = 4
# Largest entries of F − I in them: stretches from about 0.6 to 1.4, in which every usual material
# has an energy.
LARGEST_STRAIN = 0.2
# Largest relative difference of derivatives by a chain rule from those by F: both contain powers of
# the invariants, whose rounding errors are larger.
CHAIN_RULE = 1e-8
# Orthonormal strains: a stiffness that resists them all is that of a solid.
DIAGONAL = [np.diag(each) for each in np.eye(3)]


@validated
def check_material(
    material: str | Energy | Material,
    *,
    constants: Mapping[str, float] | None = None,
    is_objective: bool = True,
    largest_strain: Positive = LARGEST_STRAIN,
) -> None:
    """Check a material: energy, stress, stiffness and objectivity.

    The undeformed material has no energy and no stress, and resists every small strain. Stress
    and stiffness at random deformations, and at deformations with equal principal stretches, are
    the derivatives of the energy, by central differences, and so are the derivatives of the
    stress by the constants; a rotation changes neither the energy nor the stress in the body's
    axes.

    Parameters
    ----------
    material : str, Material or callable
        Name of a material, or energy function ``energy(F, **constants) -> ψ``.
    constants : mapping of name to float, optional
        Values of constants at which to check; by default those of a foam with E = 800 Pa, and 1
        for constants of unknown size.
    is_objective : bool
        Whether the energy does not depend on rotations; false for linear elasticity.
    largest_strain : float
        Largest entry of F − I of the random deformations; smaller for materials with a limit.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.
    InputError
        If the energy is no function of CasADi operations, or is not zero at F = I.

    Notes
    -----
    Entries of `constants` that the material does not declare are ignored.
    """
    made = as_material(material)
    check = PropertyCheck(f"material {made.name!r}")
    values = usual_constants(made.constants, constants)
    law = EnergyDerivatives(made, np.array([*values.values()]))
    _check_undeformed(check, law)
    for where, F in _deformations(check.rng, largest_strain):
        _check_derivatives(check, law, F=F, where=where)
        if is_objective:
            _check_objectivity(check, law, F=F, where=where)


@dataclass(frozen=True, eq=False)
class StressState:
    """Energy density and its derivatives at one F; tensors are stacked column after column."""

    psi: Array  # (1,): energy density ψ [J/m³]
    stress: Array  # (9,): first Piola–Kirchhoff stress P = ∂ψ/∂F [Pa]
    tangent: Array  # (9, 9): ∂P/∂F [Pa]
    # (9, k) or None: ∂P/∂θ by the k constants of the material; None if it was not computed.
    by_constants: Array | None = None


@dataclass(frozen=True, eq=False)
class EnergyDerivatives:
    """Energy density, stress and stiffness of a material as numbers."""

    material: Material
    values: Array  # (k,): values of its constants

    @cached_property
    def _function(self) -> ca.Function:
        """ψ, P = ∂ψ/∂F and ∂P/∂F of F (9,), differentiated automatically."""
        F = ca.SX.sym("F", 9)
        psi = self.material.psi(ca.reshape(F, 3, 3), ca.SX(ca.DM(self.values)))
        tangent, stress = ca.hessian(psi, F)
        return ca.Function("law", [F], [psi, stress, tangent])

    @cached_property
    def _kernel_function(self) -> ca.Function:
        """Function of F (9,) and the constants: ψ, P, ∂P/∂F and ∂P/∂θ, differentiated as in
        kernels, by the chain rule of the material's invariants.
        """
        F = ca.SX.sym("F", 9)
        values = ca.SX.sym("values", len(self.values))
        gradient = ca.reshape(F, 3, 3)
        rule = self.material.chain_rule(gradient, values)
        psi = self.material.psi_in(rule, gradient, values=values)
        stress = rule.gradient(psi, F)
        outputs = [psi, stress, rule.jacobian(stress, F), rule.jacobian(stress, values)]
        return ca.Function("kernel", [F, values], rule.eliminate(outputs))

    def evaluate(self, F: Array) -> StressState:
        """Return energy, stress and stiffness at F (9,), stacked column after column."""
        outputs = [output.full() for output in self._function.call([F])]
        return StressState(outputs[0].ravel(), outputs[1].ravel(), tangent=outputs[2])

    def evaluate_kernel(self, F: Array, values: Array | None = None) -> StressState:
        """Return energy, stress, stiffness and `by_constants`, differentiated as in kernels.

        Parameters
        ----------
        F : (9,) array
        values : (k,) array, optional
            Values of the constants in place of those of this object.
        """
        constants = self.values if values is None else values
        outputs = [each.full() for each in self._kernel_function.call([F, constants])]
        return StressState(
            outputs[0].ravel(), outputs[1].ravel(), tangent=outputs[2], by_constants=outputs[3]
        )

    def evaluate_plain(self, F: Array) -> Array:
        """Return ψ (1,) at F (9,), column after column, by calling the energy function of the
        material with numbers.
        """
        named = {
            c.name: float(v) for c, v in zip(self.material.constants, self.values, strict=True)
        }
        psi = self.material.energy(ca.DM(F.reshape(3, 3, order="F")), **named)
        return np.ravel(ca.evalf(ca.SX(psi)).full())


def deformation_gradients(
    rng: np.random.Generator, count: int, largest_strain: float
) -> Iterator[Array]:
    """Yield `count` random deformation gradients (9,), column after column, with det F ≥ 0.1.

    Parameters
    ----------
    largest_strain : float
        Entries of F − I are uniform between minus and plus this; draws with a smaller determinant
        are repeated.
    """
    for _ in range(count):
        F = np.eye(3) + rng.uniform(-largest_strain, largest_strain, (3, 3))
        while np.linalg.det(F) < 0.1:
            F = np.eye(3) + rng.uniform(-largest_strain, largest_strain, (3, 3))
        yield F.ravel(order="F")


def _deformations(rng: np.random.Generator, largest_strain: float) -> Iterator[tuple[str, Array]]:
    """Yield pairs of a description and a deformation gradient (9,): `DEFORMATIONS` random ones,
    then a uniaxial and a volumetric stretch of 1 + `largest_strain`, and both of 1 −
    `largest_strain`.
    """
    for number, F in enumerate(
        deformation_gradients(rng, DEFORMATIONS, largest_strain=largest_strain)
    ):
        yield (f"at random deformation {number} (strains up to {largest_strain:g})", F)
    for stretch in (1 + largest_strain, 1 - largest_strain):
        yield (f"at a uniaxial stretch of {stretch:g}", np.diag([1.0, 1.0, stretch]).ravel())
        yield (f"at a volumetric stretch of {stretch:g}", stretch * np.eye(3).ravel())


def random_rotation(rng: np.random.Generator) -> Array:
    """Return a rotation matrix (3, 3), uniformly distributed."""
    return Rotation.from_quat(rng.standard_normal(4)).as_matrix()


def _check_undeformed(check: PropertyCheck, law: EnergyDerivatives) -> None:
    """Require zero energy and stress, and a positive stiffness, at F = I."""
    state = law.evaluate(np.eye(3).ravel())
    stiffness = max(float(np.abs(state.tangent).max()), np.finfo(float).tiny)
    zero = np.zeros(9)
    where = "of the undeformed material is not zero"
    check.require_equal(state.psi, zero[:1], statement=f"the energy {where}", scale=stiffness)
    check.require_equal(state.stress, zero, statement=f"the stress {where}", scale=stiffness)
    shears = [(np.outer(a, b) + np.outer(b, a)) / np.sqrt(2) for a, b in _axis_pairs()]
    strains = np.array([each.ravel() for each in (*DIAGONAL, *shears)])
    smallest = np.linalg.eigvalsh(strains @ state.tangent @ strains.T)[0]
    if not smallest > 0:
        check.fail(
            "the undeformed material does not resist every strain", smallest, expected="above 0 Pa"
        )


def _axis_pairs() -> list[tuple[Array, Array]]:
    """Return the three pairs of different coordinate axes, as unit vectors (3,)."""
    axes = np.eye(3)
    return [(axes[0], axes[1]), (axes[0], axes[2]), (axes[1], axes[2])]


def _check_derivatives(check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str) -> None:
    """Require that the energy is finite and equal to its function called with numbers, that stress
    and stiffness are its derivatives by central differences, and that those of kernels agree.
    """
    state = law.evaluate(F)
    if not np.isfinite(state.psi).all():
        check.fail(
            f"the energy is not finite {where}",
            state.psi[0],
            expected="a finite energy, or a smaller largest_strain",
        )
    check.require_equal(
        state.psi, law.evaluate_plain(F), statement=f"the energy differs from its function {where}"
    )
    check.require_derivative(
        lambda at: law.evaluate(at).psi,
        state.stress,
        point=F,
        statement=f"P is not ∂ψ/∂F {where}",
        scale=0.1,
    )
    check.require_derivative(
        lambda at: law.evaluate(at).stress,
        state.tangent,
        point=F,
        statement=f"∂P/∂F is wrong {where}",
        scale=0.1,
    )
    _check_kernel_derivatives(check, law, F=F, where=where)


def _check_kernel_derivatives(
    check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str
) -> None:
    """Require that energy, stress and stiffness of kernels are those of
    `EnergyDerivatives.evaluate`, and that ∂P/∂θ agrees with central differences by the constants.
    """
    plain = law.evaluate(F)
    kernel = law.evaluate_kernel(F)
    assert kernel.by_constants is not None
    # Stress and energy may vanish, in a volumetric stretch for instance.
    stiffness = float(np.abs(plain.tangent).max())
    for name, value, expected in (
        ("ψ", kernel.psi, plain.psi),
        ("P", kernel.stress, plain.stress),
        ("∂P/∂F", kernel.tangent, plain.tangent),
    ):
        check.require_equal(
            value,
            expected,
            statement=f"{name} of the compiled kernels differs from that of the energy {where}",
            tolerance=CHAIN_RULE,
            scale=stiffness,
        )
    sizes = np.maximum(np.abs(law.values), np.finfo(float).tiny)
    check.require_derivative(
        lambda values: law.evaluate_kernel(F, values).stress,
        kernel.by_constants,
        point=law.values,
        statement=f"∂P/∂θ is wrong {where}",
        scale=sizes,
    )


def _check_objectivity(check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str) -> None:
    """Require ψ(QF) = ψ(F) and P(QF) = Q P(F) at one F (9,) for one random rotation Q."""
    state = law.evaluate(F)
    Q = random_rotation(check.rng)
    rotated = law.evaluate((Q @ F.reshape(3, 3, order="F")).ravel(order="F"))
    check.require_equal(
        rotated.psi, state.psi, statement=f"a rotation changes the energy {where}", tolerance=1e-8
    )
    check.require_equal(
        rotated.stress.reshape(3, 3, order="F"),
        Q @ state.stress.reshape(3, 3, order="F"),
        statement=f"the stress does not rotate with the body {where}",
        tolerance=1e-8,
    )
