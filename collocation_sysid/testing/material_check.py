"""Check of a strain-energy density: `check_material`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..fem.body import Body
from ..fem.laws.constants import Constant
from ..fem.laws.materials import DAMPINGS, Energy, Material, as_material
from ..problem.code_loader import CodeLoader
from ..problem.schema import CodeSection
from .internal_force_check import check_internal_forces
from .missing_constant_check import check_missing_constant
from .program_derivatives import check_program
from .property_check import PropertyCheck
from .round_trip import check_pickling, check_problem_file
from .small_problems import (
    DENSITY_KG_M3,
    program_of,
    swung_experiment,
    uneven_box,
    usual_constants,
)

# Number of random deformations.
DEFORMATIONS = 4
# Largest entries of F − I in them: stretches from about 0.6 to 1.4, in which every usual material
# has an energy.
LARGEST_STRAIN = 0.2
# Largest entry of F − I at which energies are compared after pickling: small, for materials with a
# limit.
ROUND_TRIP = 0.02
# Largest relative difference of derivatives by a chain rule from those by F: both contain powers of
# the invariants, whose rounding errors are larger.
CHAIN_RULE = 1e-8
# Orthonormal strains: a stiffness that resists them all is that of a solid.
DIAGONAL = [np.diag(each) for each in np.eye(3)]


def check_material(
    material: str | Energy | Material,
    *,
    constants: Mapping[str, float] | None = None,
    is_objective: bool = True,
    elements: Sequence[str] = ("tet4",),
    has_memory: bool = False,
    largest_strain: float = LARGEST_STRAIN,
    file: str | Path | None = None,
    function: str | None = None,
) -> None:
    """Check a material: energy, stress, stiffness, objectivity, compiled forces and round trips.

    The undeformed material has no energy and no stress, and resists every small strain. Stress
    and stiffness at random deformations, and at deformations with equal principal stretches, are
    the derivatives of the energy, by central differences, and so are the derivatives of the
    stress by the constants; a rotation changes neither the energy nor the stress in the body's
    axes. The compiled forces of a small body, and their derivatives of first and second order by
    positions, velocities and constants, agree with a plain sum over its elements and CasADi's
    automatic derivatives of it, and with central differences. A missing or misspelt constant is
    refused by its name. The material can be pickled.

    Parameters
    ----------
    material : str, Material or callable
        Name of a material, or energy function ``energy(F, **constants) -> ψ``.
    constants : mapping of name to float, optional
        Values of constants at which to check; by default those of a foam with E = 800 Pa, and 1
        for constants of unknown size.
    is_objective : bool
        Whether the energy does not depend on rotations; false for linear elasticity.
    elements : sequence of str
        Elements of the small body: "tet4", "tet10" and "tet10-p0".
    has_memory : bool
        Whether to check a small program in which the material has a branch of memory, too.
    largest_strain : float
        Largest entry of F − I of the random deformations; smaller for materials with a limit.
    file : str or Path, optional
        Python file that contains the energy function, to check that a problem file can name it.
        The file is run.
    function : str, optional
        Name of the function in the file; by default that of the energy function.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.
    InputError
        If the energy is no function of CasADi operations, or is not zero at F = I.
    """
    made = as_material(material)
    check = PropertyCheck(f"material {made.name!r}")
    values = usual_constants(made.constants, constants)
    law = EnergyDerivatives(made, np.array([*values.values()]))
    _check_undeformed(check, law)
    for where, F in _deformations(check.rng, largest_strain):
        _check_derivatives(check, law, F, where)
        if is_objective:
            _check_objectivity(check, law, F, where)
    _check_messages(check, made, values)
    _check_round_trips(check, made, values, file, function)
    for element in elements:
        check_internal_forces(
            check,
            made,
            damping=DAMPINGS["kelvin-voigt"],
            values=values,
            element=element,
            is_objective=is_objective,
            is_dissipative=True,
        )
    if has_memory:
        body = Body(
            uneven_box(1), made, density_kg_m3=DENSITY_KG_M3, prony=["prony_1"]
        )
        check_program(check, program_of(swung_experiment(body), values))


@dataclass(frozen=True, eq=False)
class EnergyDerivatives:
    """Energy density, stress and stiffness of a material as numbers.

    Attributes
    ----------
    material : Material
    values : (k,) array
        Values of its constants.
    """

    material: Material
    values: Array

    @cached_property
    def _function(self) -> ca.Function:
        """Function of F (9,), column after column."""
        F = ca.SX.sym("F", 9)
        psi = self.material.psi(ca.reshape(F, 3, 3), ca.SX(ca.DM(self.values)))
        tangent, stress = ca.hessian(psi, F)
        return ca.Function("law", [F], [psi, stress, tangent])

    @cached_property
    def _kernel_function(self) -> ca.Function:
        """Function of F (9,) and the constants, differentiated as in kernels: by a chain rule."""
        F = ca.SX.sym("F", 9)
        values = ca.SX.sym("values", len(self.values))
        gradient = ca.reshape(F, 3, 3)
        rule = self.material.chain_rule(gradient, values)
        psi = self.material.psi_in(rule, gradient, values)
        stress = rule.gradient(psi, F)
        outputs = [
            psi,
            stress,
            rule.jacobian(stress, F),
            rule.jacobian(stress, values),
        ]
        return ca.Function("kernel", [F, values], rule.eliminate(outputs))

    def evaluate(self, F: Array) -> tuple[Array, Array, Array]:
        """Return ψ (1,), P (9,) and ∂P/∂F (9, 9) at F (9,), stacked column after column."""
        psi, stress, tangent = (
            output.full() for output in self._function.call([F])
        )
        return psi.ravel(), stress.ravel(), tangent

    def evaluate_kernel(
        self, F: Array, values: Array | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Return ψ, P and ∂P/∂F like `evaluate`, and ∂P/∂θ (9, k), as kernels differentiate.

        Parameters
        ----------
        F : (9,) array
        values : (k,) array, optional
            Values of the constants in place of those of this object.
        """
        constants = self.values if values is None else values
        outputs = (
            each.full() for each in self._kernel_function.call([F, constants])
        )
        psi, stress, tangent, by_constants = outputs
        return psi.ravel(), stress.ravel(), tangent, by_constants

    def evaluate_plain(self, F: Array) -> Array:
        """Return ψ (1,) by calling the energy function with numbers."""
        named = {
            c.name: float(v)
            for c, v in zip(self.material.constants, self.values, strict=True)
        }
        psi = self.material.energy(ca.DM(F.reshape(3, 3, order="F")), **named)
        return np.ravel(ca.evalf(ca.SX(psi)).full())


def deformation_gradients(
    rng: np.random.Generator, count: int, largest_strain: float
) -> Iterator[Array]:
    """Return random deformation gradients (9,), column after column, with det F > 0.

    Parameters
    ----------
    rng : numpy.random.Generator
    count : int
    largest_strain : float
        Largest entry of F − I.
    """
    for _ in range(count):
        F = np.eye(3) + rng.uniform(-largest_strain, largest_strain, (3, 3))
        while np.linalg.det(F) < 0.1:
            F = np.eye(3) + rng.uniform(-largest_strain, largest_strain, (3, 3))
        yield F.ravel(order="F")


def _deformations(
    rng: np.random.Generator, largest_strain: float
) -> Iterator[tuple[str, Array]]:
    """Return descriptions and deformation gradients (9,): random ones, then equal stretches."""
    for number, F in enumerate(
        deformation_gradients(rng, DEFORMATIONS, largest_strain=largest_strain)
    ):
        yield (
            f"at random deformation {number} (strains up to {largest_strain:g})",
            F,
        )
    for stretch in (1 + largest_strain, 1 - largest_strain):
        yield (
            f"at a uniaxial stretch of {stretch:g}",
            np.diag([1.0, 1.0, stretch]).ravel(),
        )
        yield (
            f"at a volumetric stretch of {stretch:g}",
            stretch * np.eye(3).ravel(),
        )


def random_rotation(rng: np.random.Generator) -> Array:
    """Return a random rotation matrix (3, 3)."""
    return Rotation.from_quat(rng.standard_normal(4)).as_matrix()


def _check_undeformed(check: PropertyCheck, law: EnergyDerivatives) -> None:
    """Require no energy and stress at F = I, and resistance to every small strain."""
    psi, stress, tangent = law.evaluate(np.eye(3).ravel())
    stiffness = max(float(np.abs(tangent).max()), np.finfo(float).tiny)
    zero = np.zeros(9)
    where = "of the undeformed material is not zero"
    check.require_equal(
        psi, zero[:1], statement=f"the energy {where}", scale=stiffness
    )
    check.require_equal(
        stress, zero, statement=f"the stress {where}", scale=stiffness
    )
    shears = [
        (np.outer(a, b) + np.outer(b, a)) / np.sqrt(2) for a, b in _pairs()
    ]
    strains = np.array([each.ravel() for each in (*DIAGONAL, *shears)])
    smallest = np.linalg.eigvalsh(strains @ tangent @ strains.T)[0]
    if not smallest > 0:
        check.fail(
            "the undeformed material does not resist every strain",
            smallest,
            "above 0 Pa",
        )


def _pairs() -> list[tuple[Array, Array]]:
    """Return the pairs of different axes."""
    axes = np.eye(3)
    return [(axes[0], axes[1]), (axes[0], axes[2]), (axes[1], axes[2])]


def _check_derivatives(
    check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str
) -> None:
    """Require that stress and stiffness are the derivatives of the energy."""
    psi, stress, tangent = law.evaluate(F)
    if not np.isfinite(psi).all():
        check.fail(
            f"the energy is not finite {where}",
            psi[0],
            "a finite energy, or a smaller largest_strain",
        )
    check.require_equal(
        psi,
        law.evaluate_plain(F),
        statement=f"the energy differs from its function {where}",
    )
    check.require_derivative(
        lambda at: law.evaluate(at)[0],
        stress,
        F,
        statement=f"P is not ∂ψ/∂F {where}",
        scale=0.1,
    )
    check.require_derivative(
        lambda at: law.evaluate(at)[1],
        tangent,
        F,
        statement=f"∂P/∂F is wrong {where}",
        scale=0.1,
    )
    _check_kernel_derivatives(check, law, F=F, where=where)


def _check_kernel_derivatives(
    check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str
) -> None:
    """Require that the derivatives of kernels are those of the energy by F and the constants."""
    plain = law.evaluate(F)
    *kernel, by_constants = law.evaluate_kernel(F)
    # Stress and energy may vanish, in a volumetric stretch for instance.
    stiffness = float(np.abs(plain[2]).max())
    for name, found, expected in zip(
        ("ψ", "P", "∂P/∂F"), kernel, plain, strict=True
    ):
        check.require_equal(
            found,
            expected,
            statement=f"{name} of kernels differs from the energy's {where}",
            tolerance=CHAIN_RULE,
            scale=stiffness,
        )
    sizes = np.maximum(np.abs(law.values), np.finfo(float).tiny)
    check.require_derivative(
        lambda values: law.evaluate_kernel(F, values)[1],
        by_constants,
        law.values,
        statement=f"∂P/∂θ is wrong {where}",
        scale=sizes,
    )


def _check_objectivity(
    check: PropertyCheck, law: EnergyDerivatives, F: Array, where: str
) -> None:
    """Require ψ(QF) = ψ(F) and P(QF) = Q P(F)."""
    psi, stress, _ = law.evaluate(F)
    Q = random_rotation(check.rng)
    rotated = (Q @ F.reshape(3, 3, order="F")).ravel(order="F")
    rotated_psi, rotated_stress, _ = law.evaluate(rotated)
    check.require_equal(
        rotated_psi,
        psi,
        statement=f"a rotation changes the energy {where}",
        tolerance=1e-8,
    )
    check.require_equal(
        rotated_stress.reshape(3, 3, order="F"),
        Q @ stress.reshape(3, 3, order="F"),
        statement=f"the stress does not rotate with the body {where}",
        tolerance=1e-8,
    )


def _check_messages(
    check: PropertyCheck, material: Material, values: dict[str, float]
) -> None:
    """Require that a missing constant and a misspelt definition are refused by their names."""
    misspelt = f"no_{material.constants[0].name}"
    check.require_refusal(
        lambda: Material.from_energy(
            material.energy, material.name, Constant(misspelt)
        ),
        naming=misspelt,
        statement=f"the definition of {misspelt!r}, which the energy does not have",
    )
    check_missing_constant(check, values, material=material)


def _check_round_trips(
    check: PropertyCheck,
    material: Material,
    values: dict[str, float],
    file: str | Path | None,
    function: str | None,
) -> None:
    """Require the same energies after pickling and from a problem file."""
    constants = np.array([*values.values()])
    deformations = [
        *deformation_gradients(
            np.random.default_rng(0), DEFORMATIONS, largest_strain=ROUND_TRIP
        )
    ]

    def evaluate(made: Material) -> Array:
        """Return ψ at a few deformations."""
        law = EnergyDerivatives(made, constants)
        return np.concatenate([law.evaluate_plain(F) for F in deformations])

    def load(loader: CodeLoader, table: Mapping[str, Any]) -> Material:
        """Return the material of a table of a problem file."""
        return loader.material(
            CodeSection.model_validate(table), "object.material"
        )

    check_pickling(check, material, evaluate=evaluate)
    if file is not None:
        name = function or getattr(material.energy, "__name__", material.name)
        table = {"file": Path(file).name, "function": name}
        check_problem_file(
            check,
            file,
            table=table,
            load=load,
            extension=material,
            evaluate=evaluate,
        )
