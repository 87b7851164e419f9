"""Homogeneous specimens without a mesh: stretch or strain against engineering stress.

`Specimen` has the measurements; `Specimen.experiment` returns a static `Experiment` of a cell of
linear tetrahedra, which represents the homogeneous deformation exactly, see
`homogeneous_deformation`. Everything that works with a static experiment works with it.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.checked_arrays import float_array, float_converter
from ..common.declarations import declaration, key
from ..common.validated_classes import validated
from ..common.validated_types import Finite, Flag, NotNegative, Positive, PositivePerSample, Text
from ..errors import InputError
from ..fem.body import Body, Made
from ..fem.laws.fibres import Fibres
from ..fem.laws.materials import DampingLaw, Energy, Material, Prony
from ..fem.laws.time_shift import TimeShift
from .custom_sensor import Gauge, GraspQuantities, PointQuantities
from .experiment import Experiment
from .grasp import Grasp
from .homogeneous_deformation import (
    AXES,
    CELL_SIZE_M,
    DEFORMATIONS,
    STRESS_PER_FORCE,
    TESTS,
    HomogeneousDeformation,
    cell_mesh,
    shape_factor,
)
from .nuisance import SPECIMEN_STIFFNESS, Nuisance
from .poses import PoseSequence
from .specimen_stretches import require_evaluable_law

# Density of a cell [kg/m³], on which no equilibrium without gravity depends.
CELL_DENSITY_KG_M3 = 1000.0
# Standard deviation of the zero of the strain: 0.1 mm on a gauge length of 50 mm.
STRAIN_ZERO = 2e-3
# Standard deviation of the relative error of the area: 0.02 mm on a thickness of 2 mm.
AREA_ERROR = 0.01
# Standard deviation of the relative difference between the stiffness of a specimen and that of its
# material: cast silicones differ by 1 to 8 %.
SPECIMEN_SPREAD = 0.05
# Standard deviation of a measured lateral stretch: 0.1 mm on a width of 20 mm.
LATERAL_SIGMA = 5e-3
# Strain of a table of a relaxation modulus, at which every law is linear.
RELAXED_STRAIN = 1e-4
# Negative loss modulus over the storage modulus that may be noise about zero.
LOSS_NOISE = 0.1
# Tests that a table of a modulus may be of: of E and of G.
MODULUS_TESTS = ("uniaxial", "simple-shear")
STRESS_NAME = "stress"
SECOND_STRESS_NAME = "second stress"
LATERAL_NAME = "lateral stretch"
STRESS_UNIT = "Pa"


@declaration
class Specimen:
    """Measurements of a material test in which the deformation is homogeneous.

    The strain is that of the test: stretch minus one in "uniaxial", "equibiaxial", "biaxial",
    "planar" (pure shear) and "confined" tests, the amount of shear γ in "simple-shear", and the
    change of every length, J^(1/3) − 1, in "volumetric" tests. Stresses are engineering (nominal)
    stresses: force over undeformed area, positive in tension; in "biaxial-difference" tests they
    are the difference of both true stresses. Stresses across free surfaces vanish.

    Parameters
    ----------
    test : str
        "uniaxial", "equibiaxial", "biaxial", "biaxial-difference", "planar", "simple-shear",
        "confined" or "volumetric".
    strain : (T,) array
        Strain of each sample.
    stress_pa : (T,) array
        Engineering stress of each sample; NaN where missing. In "simple-shear" the shear stress
        P_xz on a plane that keeps its normal; in "volumetric" the normal stress −p J^(2/3) of a
        pressure p; in "biaxial-difference" the difference of the true stresses along the first and
        the second axis, multiplied by J.
    sigma_pa : float or (T,) array
        Standard deviation of the noise of the stresses, of all samples or of each.
    t_s : (T,) array, optional
        Times, ascending; rows are numbered in seconds by default, which a material with memory
        does not accept from files.
    second_strain : (T,) array, optional
        Strain along the second axis of a "biaxial" or "biaxial-difference" test.
    second_stress_pa : (T,) array, optional
        Stress along the second axis of a "biaxial" or "planar" test; NaN where missing.
    lateral_stretch : (T,) array, optional
        Stretch of a free direction, which determines Poisson's ratio; NaN where missing.
    lateral_sigma : float or (T,) array
        Standard deviation of the noise of the lateral stretch.
    strain_zero : float
        Standard deviation of a constant offset of the strains, which is estimated; 0 if exact.
    area_error : float
        Standard deviation of the relative error of the area, which is estimated; 0 if exact.
    stress_zero_pa : float
        Standard deviation of a constant offset of the stresses, which is estimated; 0 if exact.
    specimen : str
        Name of the specimen, without blanks, if several tests of it are fitted: they share the
        relative difference between its stiffness and that of its material, which is estimated.
    specimen_stiffness : float
        Standard deviation of this difference.
    axial_stretch : float
        Constant stretch of a "simple-shear" test along the normal of the planes that slide. The
        amount of shear γ is the displacement of these planes over their distance after this
        stretch.
    transverse_stretch : float, optional
        Constant stretch across `axial_stretch`; by default 1/√axial_stretch, that of an
        incompressible specimen.
    cut_angle_deg : float
        Angle [°] at which the specimen was cut from a sheet with fibres: from the axis z of the
        sheet, in which the direction of the fibres is stated, to the axis of the first strain,
        positive toward the axis x of the sheet.
    shift : str
        Name of the temperature at which the specimen was tested: all relaxation times are 10 to the
        power of the parameter ``<shift>.log10_shift`` times those of the parameters.
    temperature_difference_k : float
        Instead of `shift`: temperature, less that of the parameters. The factor on the relaxation
        times is that of Williams, Landel & Ferry, with the parameters ``wlf_c1`` and ``wlf_c2_k``.
    oscillates : bool
        Whether the strain oscillates steadily and each sample is a quarter of a period after the one
        before, see `harmonic`.
    length_m, area_m2 : float, optional
        Undeformed length and area of the specimen, if `strain` is the displacement of a test bench
        over the length: the budget then contains the compliance of the bench. None (both) if the
        strain was measured on the specimen.

    Raises
    ------
    InputError
        For an unknown test, arrays of different lengths, a stretch that is not positive, a
        measurement that the test does not have, or a length without an area.
    """

    test: str
    strain: Array = key(converter=float_converter((None,), "strain"))
    stress_pa: Array = key(converter=float_converter((None,), "stress_pa", finite=False))
    sigma_pa: float | Array = key(Positive, accepted=PositivePerSample)
    t_s: Array = key(converter=float_converter((None,), "t_s"), default=None)
    second_strain: Array | None = key(
        converter=float_converter((None,), "second_strain"), default=None
    )
    second_stress_pa: Array | None = key(
        converter=float_converter((None,), "second_stress_pa", finite=False), default=None
    )
    lateral_stretch: Array | None = key(
        converter=float_converter((None,), "lateral_stretch", finite=False), default=None
    )
    lateral_sigma: float | Array = key(Positive, accepted=PositivePerSample, default=LATERAL_SIGMA)
    strain_zero: float = key(NotNegative, default=STRAIN_ZERO)
    area_error: float = key(NotNegative, default=AREA_ERROR)
    stress_zero_pa: float = key(NotNegative, default=0.0)
    specimen: str = key(Text, default="")
    specimen_stiffness: float = key(Positive, default=SPECIMEN_SPREAD)
    axial_stretch: float = key(Positive, default=1.0)
    transverse_stretch: float | None = key(Positive, default=None)
    cut_angle_deg: float = key(Finite, default=0.0)
    shift: str = key(Text, default="")
    temperature_difference_k: float = key(Finite, default=0.0)
    oscillates: bool = key(Flag, default=False)
    length_m: float | None = key(Positive, default=None)
    area_m2: float | None = key(Positive, default=None)

    def __post_init__(self) -> None:
        if self.test not in DEFORMATIONS:
            raise InputError(
                f"found {self.test!r}; expected one of {', '.join(TESTS)}", None, where="test"
            )
        times = np.arange(float(len(self.strain))) if self.t_s is None else self.t_s
        vars(self)["t_s"] = times
        self._require_measurements_of_test()
        if self.shift and self.temperature_difference_k:
            raise InputError(
                f'found shift = "{self.shift}" and temperature_difference_k; expected one of them',
                None,
                where="shift",
            )
        if (self.length_m is None) != (self.area_m2 is None):
            raise InputError(
                "found one of length_m and area_m2; expected both, or neither for a strain that "
                "was measured on the specimen",
                None,
                where="length_m",
            )
        for name in (
            *("stress_pa", "sigma_pa", "t_s", "second_strain", "second_stress_pa"),
            *("lateral_stretch", "lateral_sigma"),
        ):
            values = getattr(self, name)
            if np.ndim(values) and len(values) != len(self.strain):
                raise InputError(
                    f"found {len(values)} values for {len(self.strain)} strains; expected one value "
                    "for each strain",
                    None,
                    where=name,
                )
        for name in ("strain", "second_strain"):
            values = getattr(self, name)
            if values is None or self.find_deformation().test == "simple-shear":
                continue
            if (lowest := values.min(initial=0.0)) <= -1.0:
                raise InputError(
                    f"found a strain of {lowest:g} in row {int(values.argmin()) + 1}, in which the "
                    "length is zero or negative; expected more than −1. If these are percent, divide them "
                    'by 100, or call the column "strain (%)"',
                    None,
                    where=name,
                )

    def _require_measurements_of_test(self) -> None:
        of = f"a {self.test} test"
        if (self.second_strain is None) == bool(self.find_deformation().second):
            fault = (
                f"{of} needs a second strain, along its second axis"
                if self.second_strain is None
                else f"{of} does not have a second strain; leave it out"
            )
            raise InputError(fault, None, where="second_strain")
        if self.test != "simple-shear" and (self.axial_stretch, self.transverse_stretch) != (
            1,
            None,
        ):
            raise InputError(
                f"{of} has no constant stretch beside its strains; expected axial_stretch and "
                'transverse_stretch with test = "simple-shear" only',
                None,
                where="axial_stretch",
            )
        if self.second_stress_pa is not None and not self.find_deformation().second_stress:
            raise InputError(
                f"{of} does not have a second stress; leave it out", None, where="second_stress_pa"
            )
        if self.lateral_stretch is not None and not self.find_deformation().lateral:
            raise InputError(
                f"{of} has no direction in which the specimen is free to contract; leave the lateral "
                "stretch out",
                None,
                where="lateral_stretch",
            )

    def find_deformation(self) -> HomogeneousDeformation:
        """Return the kind of deformation of the test, with the components of F that it prescribes.

        With `length_m` and `area_m2` it has also the area over the length of the specimen, which
        the compliance of the test bench needs, and the shape factor.
        """
        deformation = DEFORMATIONS[self.test]
        if self.axial_stretch != 1 or self.transverse_stretch is not None:
            deformation = deformation.pre_stretched(self.axial_stretch, self.transverse_stretch)
        if self.length_m is None or self.area_m2 is None:
            return deformation
        return replace(
            deformation,
            area_over_length_m=self.area_m2 / self.length_m,
            shape_factor=shape_factor(self.length_m, self.area_m2),
        )

    @classmethod
    @validated
    def relaxation(
        cls,
        t_s: ArrayLike,
        modulus_pa: ArrayLike,
        sigma_pa: float | ArrayLike,
        test: str = "uniaxial",
        *,
        shift: str = "",
        temperature_difference_k: float = 0.0,
    ) -> Specimen:
        """Return the test of a table of the relaxation modulus E(t) or, with "simple-shear", G(t):
        the stress over time at a small strain (`RELAXED_STRAIN`) that is applied at t = 0, over that
        strain.

        Parameters
        ----------
        t_s : (T,) array
            Times since the strain was applied, positive.
        modulus_pa : (T,) array
            Relaxation modulus [Pa]; NaN where missing.
        sigma_pa : float or (T,) array
            Standard deviation of the noise of the modulus [Pa].
        test : {"uniaxial", "simple-shear"}
        shift, temperature_difference_k
            Those of `Specimen`.

        Raises
        ------
        InputError
            If the times are not positive and increasing, or for another test.
        """
        times = float_array(t_s, "t_s", ((None,),))
        if not len(times) or times[0] <= 0 or (np.diff(times) <= 0).any():
            raise InputError("expected positive times that increase", None, where="t_s")
        _require_small_strain_test(test)
        modulus = float_array(modulus_pa, "modulus_pa", ((len(times),),), False)
        if (wrong := (modulus < 0) | np.isinf(modulus)).any():
            raise InputError(
                f"found {modulus[wrong][0]:g} in row {np.flatnonzero(wrong)[0] + 1}; expected "
                "moduli above 0, or nan where one is missing",
                None,
                where="modulus_pa",
            )
        # A ramp that is short compared with the first time; before it the specimen is at rest.
        ramp_s = 1e-6 * times[0]
        sigma = float_array(sigma_pa, "sigma_pa", ((), (len(times),)))
        return cls(
            test,
            RELAXED_STRAIN * np.r_[0.0, 1.0, np.ones(len(times))],
            RELAXED_STRAIN * np.r_[np.nan, np.nan, modulus],
            sigma_pa=RELAXED_STRAIN * (np.r_[np.nan, np.nan, sigma] if sigma.ndim else sigma),
            t_s=np.r_[-ramp_s, 0.0, times],
            strain_zero=0.0,
            shift=shift,
            temperature_difference_k=temperature_difference_k,
        )

    @classmethod
    @validated
    def harmonic(
        cls,
        frequency_hz: ArrayLike,
        storage_pa: ArrayLike,
        loss_pa: ArrayLike,
        relative_sigma: float,
        test: str = "uniaxial",
        *,
        shift: str = "",
        temperature_difference_k: float = 0.0,
    ) -> Specimen:
        """Return a harmonic test (DMA): storage modulus E′ and loss modulus E″ over frequency or,
        with "simple-shear", G′ and G″.

        A strain of at most `RELAXED_STRAIN` oscillates steadily. Its samples are a quarter of a period
        apart: at the largest strain, where the stress over the amplitude is E′, and then without
        strain, where it is −E″. The amplitudes are such that |E*| times the amplitude is the same
        for all frequencies.

        Parameters
        ----------
        frequency_hz : (F,) array
            Frequencies, positive, in any order.
        storage_pa, loss_pa : (F,) array
            Storage and loss modulus [Pa]; NaN where one of them is missing.
        relative_sigma : float
            Standard deviation of the noise of both moduli, over |E*| = √(E′² + E″²): the relative
            error of |E*|, and the error of the phase δ [rad].
        test : {"uniaxial", "simple-shear"}
        shift, temperature_difference_k
            Those of `Specimen`.

        Raises
        ------
        InputError
            If a frequency is not positive, a row has no modulus or a negative one, or for another
            test.
        """
        frequency = float_array(frequency_hz, "frequency_hz", ((None,),))
        storage = float_array(storage_pa, "storage_pa", ((len(frequency),),), False)
        loss = float_array(loss_pa, "loss_pa", ((len(frequency),),), False)
        _require_small_strain_test(test)
        if not len(frequency) or frequency.min() <= 0:
            raise InputError("expected positive frequencies", None, where="frequency_hz")
        size = np.hypot(np.nan_to_num(storage), np.nan_to_num(loss))
        for name, values, lowest in (
            ("storage_pa", storage, 0.0),
            ("loss_pa", loss, -LOSS_NOISE * np.nan_to_num(storage)),
        ):
            wrong = (values < lowest) | (size == 0) | np.isinf(values)
            if wrong.any():
                row = int(np.flatnonzero(wrong)[0]) + 1
                fault = (
                    f"found no modulus, or a negative or infinite one, in row {row}; expected "
                    "moduli above 0"
                )
                raise InputError(fault, None, where=name)
        # Beginning with the shortest period, all times have the precision of their period.
        order = np.argsort(-frequency, kind="stable")
        quarters_s = np.repeat(0.25 / frequency[order], 2)
        amplitude = RELAXED_STRAIN * size.min() / size[order]
        still = np.zeros_like(amplitude)
        stress = np.column_stack([storage[order], -loss[order]]) * amplitude[:, None]
        return cls(
            test,
            np.r_[0.0, np.column_stack([amplitude, still]).ravel()],
            np.r_[np.nan, stress.ravel()],
            sigma_pa=RELAXED_STRAIN * size.min() * relative_sigma,
            t_s=np.r_[0.0, np.cumsum(quarters_s)],
            strain_zero=0.0,
            oscillates=True,
            shift=shift,
            temperature_difference_k=temperature_difference_k,
        )

    def __repr__(self) -> str:
        return f"Specimen({self.test!r}: {len(self.strain)} samples)"

    def experiment(
        self,
        material: str | Energy | Material = "neo-hookean",
        name: str = "specimen",
        *,
        prony: tuple[str | Prony, ...] = (),
        fibres: Fibres | None = None,
        validation: bool = False,
        body: Body | None = None,
    ) -> Experiment:
        """Return the test as a static experiment of a homogeneous cell, without gravity and air.

        Parameters
        ----------
        material : str, Material or callable
            As of `Body`; not used if `body` is given.
        prony : sequence of str or Prony
            Branches of the material's memory, as of `Body`; not used if `body` is given.
        fibres : Fibres, optional
            Fibres of the sheet from which the specimen was cut, in the plane of the sheet's axes z
            and x or across it; not used if `body` is given.
        validation : bool
            Whether the test is only predicted, not fitted.
        body : Body, optional
            Cell that another specimen of the same kind of test has; made of `material` and `prony`
            by default.

        Raises
        ------
        InputError
            If the law cannot be evaluated at the largest strains, see `require_evaluable_law`.
        """
        cell = body
        if cell is None:
            angle = self.cut_angle_deg
            cell = cell_body(self.test, material, prony, fibres=fibres, cut_angle_deg=angle)
            cell = conditioned(cell, self.oscillates, self.shift, self.temperature_difference_k)
        require_evaluable_law(
            cell, self.find_deformation(), strain=self.strain, second_strain=self.second_strain
        )
        scope = {SPECIMEN_STIFFNESS.name: f"shared {self.specimen}"} if self.specimen else {}
        nuisance = Nuisance.none(scope=scope, strain_zero=self.strain_zero or None)
        return Experiment(
            cell,
            self.t_s,
            grasps=self._grasps(has_fibres=any(part.axes is not None for part in cell.parts)),
            gravity_m_s2=(0.0, 0.0, 0.0),
            name=name,
            kind="static",
            readings=self._sensors(),
            air_density_kg_m3="none",
            nuisance=nuisance,
            validation=validation,
            specimen=self.find_deformation(),
        )

    def _grasps(self, has_fibres: bool) -> list[Grasp]:
        """Return a grasp for each node of the cell; with fibres, uniaxial tension shears."""
        deformation = self.find_deformation()
        if has_fibres and self.test == "uniaxial":
            deformation = replace(deformation, free_shear=("zx",))
        shifts = deformation.gradients(self.strain, self.second_strain) - np.eye(3)
        grasps = []
        for node in range(1 + len(AXES)):
            poses = PoseSequence.fixed()
            if node and shifts[:, :, node - 1].any():
                shifts_m = CELL_SIZE_M * shifts[:, :, node - 1]
                no_rotation = np.tile([0.0, 0.0, 0.0, 1.0], (len(shifts_m), 1))
                poses = PoseSequence(
                    self.t_s, shifts_m, quaternions_xyzw=no_rotation, interpolation="linear"
                )
            axes = deformation.prescribed_axes(node)
            grasps.append(Grasp(np.array([node]), poses, axes=axes))
        return grasps

    def _sensors(self) -> list[Gauge]:
        """Return the sensors of both stresses and the lateral stretch, as far as measured."""
        sensors = []
        for name, component, values in (
            (STRESS_NAME, self.find_deformation().first_stress, self.stress_pa),
            (SECOND_STRESS_NAME, self.find_deformation().second_stress, self.second_stress_pa),
        ):
            if values is not None and np.isfinite(values).any():
                sensors.append(self._stress_sensor(name, component, values=values))
        if self.lateral_stretch is not None:
            axis = AXES.index(self.find_deformation().lateral)
            point_m = np.zeros(3)
            point_m[axis] = CELL_SIZE_M
            sensors.append(
                Gauge(
                    LATERAL_NAME,
                    LateralStretch(axis),
                    t_s=self.t_s,
                    values=self.lateral_stretch,
                    sigma=self.lateral_sigma,
                    points_m=[point_m],
                    unit="1",
                )
            )
        return sensors

    def _stress_sensor(self, name: str, component: str, values: Array) -> Gauge:
        deviations = {"area_error": self.area_error, "stress_zero_pa": self.stress_zero_pa}
        if self.specimen:
            deviations[SPECIMEN_STIFFNESS.name] = self.specimen_stiffness
        direction, normal = (AXES.index(axis) for axis in component)
        quantity = NominalStress(direction)
        if self.test == "biaxial-difference":
            assert self.second_strain is not None
            quantity = StressDifference(self.t_s, self.strain - self.second_strain)
        return Gauge(
            name,
            quantity,
            t_s=self.t_s,
            values=values,
            sigma=self.sigma_pa,
            grasp=2 + normal,
            frame="world",
            unknowns={unknown: sigma for unknown, sigma in deviations.items() if sigma},
            unit=STRESS_UNIT,
        )


class _MeasuredStress:
    """Expression of a stress, measured with a wrong area and zero on a specimen that is not as stiff
    as its material; subclasses define the stress.
    """

    def stress_pa(self, at: GraspQuantities) -> ca.SX:
        """Return the stress [Pa] from force and torque on a node of the cell."""
        raise NotImplementedError

    def __call__(
        self,
        at: GraspQuantities,
        area_error: ca.SX | float = 0.0,
        stress_zero_pa: ca.SX | float = 0.0,
        specimen_stiffness: ca.SX | float = 0.0,
    ) -> ca.SX:
        """Return the measured stress P (1 + `specimen_stiffness`) (1 + `area_error`)
        + `stress_zero_pa` [Pa].
        """
        stress_pa = self.stress_pa(at) * (1 + specimen_stiffness)
        return stress_pa * (1 + area_error) + stress_zero_pa


class NominalStress(_MeasuredStress):
    """Component of the nominal stress, by the index of the direction of its force."""

    def __init__(self, direction: int) -> None:
        self.direction = direction

    def stress_pa(self, at: GraspQuantities) -> ca.SX:
        return STRESS_PER_FORCE * at.force_n[self.direction]


class StressDifference(_MeasuredStress):
    """Difference of two principal true stresses, multiplied by J.

    The cell is at 45° to the stretches λ₁ and λ₂: the node on its axis z has the position
    ½ (λ₁ − λ₂, 0, λ₁ + λ₂) size and the nominal stress ½ (P₁ − P₂, 0, P₁ + P₂), and
    λ₁ P₁ − λ₂ P₂ = J (σ₁ − σ₂). The arguments are the times (T,) [s] and λ₁ − λ₂ (T,).
    """

    def __init__(self, t_s: Array, difference: Array) -> None:
        self.t_s = t_s
        self.difference = difference

    def stress_pa(self, at: GraspQuantities) -> ca.SX:
        difference = self.difference[0]
        if len(self.t_s) > 1:
            difference = ca.pw_lin(at.t_s, ca.DM(self.t_s), ca.DM(self.difference))
        lever_n = at.torque_nm[1] / CELL_SIZE_M + difference * at.force_n[2]
        return 2 * STRESS_PER_FORCE * lever_n


class LateralStretch:
    """Expression of the stretch along a free axis, by the position of the cell's node on that axis.

    Attributes
    ----------
    axis : int
        Index of the axis, from 0.
    """

    def __init__(self, axis: int) -> None:
        self.axis = axis

    def __call__(self, at: PointQuantities) -> ca.SX:
        return at.position_m[self.axis, 0] / CELL_SIZE_M


def is_harmonic(strain: Array) -> bool:
    """Return whether strains (T,) are those of a harmonic test, see `Specimen.harmonic`."""
    rest, amplitudes = strain[::2], strain[1::2]
    is_small = len(strain) > 1 and amplitudes.max() <= 1.001 * RELAXED_STRAIN
    return bool(is_small and len(strain) % 2 and amplitudes.min() > 0 and not rest.any())


def is_relaxation(strain: Array) -> bool:
    """Return whether strains (T,) are those of a table of a modulus, see `Specimen.relaxation`."""
    is_held = np.isclose(strain[1:], RELAXED_STRAIN, rtol=1e-3, atol=0.0).all()
    return bool(len(strain) > 2 and not strain[0] and is_held)


def moduli_per_stress(strain: Array) -> dict[str, Array]:
    """Return the factors (T,) of stresses to the moduli that they stand for, by name of the modulus;
    NaN for samples that have none. Empty unless the strains (T,) are those of a table of moduli.
    """
    with np.errstate(divide="ignore"):
        compliance = 1.0 / strain
    missing = np.full_like(strain, np.nan)
    if is_harmonic(strain):
        storage, loss = missing, missing.copy()
        storage[1::2] = compliance[1::2]
        loss[2::2] = -compliance[1::2]
        return {"storage modulus": storage, "loss modulus": loss}
    if is_relaxation(strain):
        missing[2:] = compliance[2:]
        return {"relaxation modulus": missing}
    return {}


def _require_small_strain_test(test: str) -> None:
    if test not in MODULUS_TESTS:
        fault = f'found "{test}"; expected "uniaxial" for E or "simple-shear" for G'
        raise InputError(fault, None, where="test")


def cell_body(
    test: str,
    material: str | Energy | Material = "neo-hookean",
    prony: tuple[str | Prony, ...] = (),
    damping: str | DampingLaw = "kelvin-voigt",
    made: Made | None = None,
    fibres: Fibres | None = None,
    cut_angle_deg: float = 0.0,
) -> Body:
    """Return the homogeneous cell of a kind of test, one of `TESTS`; other arguments as of `Body`
    and `Specimen`.

    The cell has an additional node inside if the test prescribes all others. The damping law has no
    effect on equilibria.
    """
    mesh = cell_mesh(with_inner_node=not DEFORMATIONS[test].free)
    return Body(
        mesh,
        material,
        density_kg_m3=CELL_DENSITY_KG_M3,
        damping=damping,
        prony=prony,
        rest_shape="stress_free",
        made=made,
        fibres=None if fibres is None else _cut(fibres, cut_angle_deg),
    )


def conditioned(cell: Body, oscillates: bool, shift: str, temperature_difference_k: float) -> Body:
    """Return a cell as it responds to a steady oscillation and at the temperature of its test, see
    `Specimen`.

    Raises
    ------
    InputError
        If it oscillates or has another temperature, but the material has no memory.
    """
    if not (oscillates or shift or temperature_difference_k):
        return cell
    if not cell.has_memory:
        raise InputError(
            "found a harmonic test, or another temperature, of a material without memory; expected "
            "branches ([[object.prony]], in Python prony=...), whose loss and relaxation times they "
            "determine",
            None,
            where="prony",
        )
    is_shifted = bool(shift or temperature_difference_k)
    factor = TimeShift(shift, temperature_difference_k) if is_shifted else None
    parts = (replace(part, oscillates=oscillates, shift=factor) for part in cell.parts)
    return cell.with_parts(tuple(parts))


def cell_of_other_test(body: Body, test: str) -> Body:
    """Return the cell of another kind of test for the specimen that has the cell `body`."""
    (part,) = body.parts
    cell = cell_body(test, part.material, part.prony, damping=part.damping, made=body.made)
    (new,) = cell.parts
    axes = None if part.axes is None else np.broadcast_to(part.axes[0], (len(new.cells), 3, 3))
    conditions = replace(new, axes=axes, oscillates=part.oscillates, shift=part.shift)
    return cell.with_parts((conditions,))


def _cut(fibres: Fibres, angle_deg: float) -> Fibres:
    """Return the fibres of a sheet by the axes of a specimen that was cut from it at an angle."""
    turn = Rotation.from_euler("y", -angle_deg, degrees=True)
    vectors = {}
    for name in ("direction", "normal"):
        vector = getattr(fibres, name)
        is_vector = vector is not None and np.shape(vector) == (3,)
        if not (is_vector or (name == "normal" and vector is None)):
            raise InputError(
                "the fibres of a specimen without a mesh have no vector as their "
                f"{name}; expected one direction for the whole sheet",
                None,
                where=f"fibres.{name}",
            )
        if vector is None:
            continue
        size = np.abs(vector) > 1e-9 * np.linalg.norm(vector)
        if (size[1] and size[[0, 2]].any()) or (name == "normal" and not size[1]):
            raise InputError(
                f"found {name} = {np.asarray(vector).tolist()} in a specimen without a mesh; expected "
                "a direction in the plane of its axes z and x, or along y, and the normal along y",
                None,
                where=f"fibres.{name}",
            )
        vectors[name] = turn.apply(vector)
    return replace(fibres, **vectors)
