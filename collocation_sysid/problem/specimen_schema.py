"""Keys of [[experiment]] with kind = "specimen": material tests without a mesh."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..common.schema_tables import Among, ByForm, Noise, require_one
from ..common.validated_types import AtLeastOne, Boundless, Count, Finite, Flag, Positive, Text
from ..recording.homogeneous_deformation import TESTS
from ..recording.specimen import AREA_ERROR, LATERAL_SIGMA, SPECIMEN_SPREAD, STRAIN_ZERO
from ..recording.specimen_files import ModulusTable
from .measurement_section import NamedSection

# Kind of deformation of the tables of a modulus, over time or frequency.
MODULI = {
    **{"relaxation": "uniaxial", "shear-relaxation": "simple-shear"},
    **{"harmonic": "uniaxial", "shear-harmonic": "simple-shear"},
}
# Keys that only other tests have.
NOT_OF_MODULI = frozenset(
    (
        *("strain_sign", "stress_sign", "stress", "length_m", "area_m2", "axial_stretch"),
        *("transverse_stretch", "cut_angle_deg", "sigma_n", "lateral_sigma", "strain_zero"),
        *("stress_zero_pa", "skip_cycles", "branch"),
    )
)
Prior = Annotated[Literal["none"] | Positive, ByForm(str)]


class SpecimenSection(NamedSection):
    """One material test with a homogeneous deformation, which needs no mesh.

    Columns of the file are recognised by name and unit: a stretch, a strain, or a displacement with
    length_m; a stress, or a force with area_m2; optionally a lateral stretch or strain.

    Attributes
    ----------
    kind : {"specimen"}
        Homogeneous specimen.
    test : str
        Kind of test; stresses across free surfaces vanish. "relaxation" is a table of the times and
        of the relaxation modulus E(t), "shear-relaxation" one of G(t); "harmonic" is one of the
        frequencies, storage and loss moduli E′ and E″ (DMA), "shear-harmonic" of G′ and G″.
    file : str
        Table with a row for each sample, in the order of time.
    columns : mapping of name to str
        Column of the file for each quantity (stretch, strain, displacement, stress, force,
        pressure, lateral_stretch, …, t) whose column is not recognised by its name. A unit that the
        file does not state is added to the name, as in "Load (N)".
    header_line : int, optional
        Line of the column names in the file, if it is not the one above the longest table.
    strain_sign : {1, -1}
        -1 if the strains or displacements in the file are positive in compression.
    stress_sign : {1, -1}
        -1 if the stresses or forces in the file are positive in compression.
    stress : {"engineering", "true"}
        "engineering": the stress is the force over the undeformed area. "true": it is the force
        over the deformed area.
    length_m : float, optional
        Undeformed length by which a displacement is divided; in a shear test, the height of the
        gap, after axial_stretch.
    axial_stretch : float
        Constant stretch of a simple-shear test along the normal of the planes that slide, such as
        0.8 of a specimen that is compressed by 20 % and then sheared.
    transverse_stretch : float, optional
        Constant stretch across axial_stretch; by default that of an incompressible specimen,
        1/√axial_stretch.
    cut_angle_deg : float
        Angle at which the specimen was cut from a sheet with fibres (object.fibres): from the axis
        z of the sheet to the axis of the first strain, positive toward the axis x.
    area_m2 : float, optional
        Undeformed area by which a force is divided.
    sigma_pa : float or str, optional
        Standard deviation of the noise of the stress, or the column of the file that has that of
        each row.
    relative_sigma : float, optional
        Standard deviation of the noise of storage and loss modulus, over |E*|, of a harmonic test.
    shift : str
        Name of the temperature of the test: its relaxation times are 10^x times those of the
        parameters, where x is the parameter <shift>.log10_shift.
    temperature_difference_k : float
        Instead of shift: temperature of the test, less that of the parameters, by which the
        parameters wlf_c1 and wlf_c2_k shift the relaxation times.
    sigma_n : float or str, optional
        Standard deviation of the noise of the force, or its column, which is divided by area_m2;
        instead of sigma_pa.
    lateral_sigma : float or str
        Standard deviation of the noise of the lateral stretch, or its column.
    strain_zero : float or "none"
        Standard deviation of a constant offset of the strains, which is estimated.
    specimen : str
        Name of the specimen, if several tests of it are fitted: they share specimen_stiffness.
    specimen_stiffness : float
        Standard deviation of the relative difference between the stiffness of the specimen and that
        of its material, which is estimated.
    area_error : float or "none"
        Standard deviation of the relative error of the area, which is estimated.
    stress_zero_pa : float or "none"
        Standard deviation of a constant offset of the stress, which is estimated.
    skip_cycles : int
        Number of loading cycles at the beginning that are excluded, because rubber softens in them
        (Mullins effect).
    branch : {"both", "loading"}
        "both": all samples are used. "loading": only those samples of the last cycle are used in
        which the magnitude of the strain increases, because the stress during unloading is smaller
        (hysteresis).
    window_s : list, optional
        First and last time to use [start, end].
    every : int
        Use every n-th row.
    validation : bool
        Whether the test is only predicted, not fitted.
    """

    kind: Literal["specimen"]
    test: Annotated[str, Among((*TESTS, *MODULI))]
    file: Text
    columns: dict[str, Text] = Field(default_factory=dict)
    header_line: AtLeastOne | None = None
    strain_sign: Literal[1, -1] = 1
    stress_sign: Literal[1, -1] = 1
    stress: Literal["engineering", "true"] = "engineering"
    length_m: Positive | None = None
    axial_stretch: Positive = 1.0
    transverse_stretch: Positive | None = None
    cut_angle_deg: Finite = 0.0
    area_m2: Positive | None = None
    sigma_pa: Noise | None = None
    relative_sigma: Positive | None = None
    shift: Annotated[str, Field(pattern=r"^[\w-]*$")] = ""
    temperature_difference_k: Finite = 0.0
    sigma_n: Noise | None = None
    lateral_sigma: Noise = LATERAL_SIGMA
    strain_zero: Prior = STRAIN_ZERO
    specimen: Annotated[str, Field(pattern=r"^\S*$")] = ""
    specimen_stiffness: Positive = SPECIMEN_SPREAD
    area_error: Prior = AREA_ERROR
    stress_zero_pa: Prior = "none"
    skip_cycles: Count = 0
    branch: Literal["both", "loading"] = "both"
    window_s: tuple[Boundless, Boundless] | None = None
    every: AtLeastOne = 1
    validation: Flag = False

    @property
    def deformation(self) -> str:
        """Kind of test of the homogeneous deformation."""
        return MODULI.get(self.test, self.test)

    @property
    def modulus(self) -> ModulusTable | None:
        """Whether the table has a modulus over time or over frequency."""
        if self.test not in MODULI:
            return None
        return "harmonic" if self.test.endswith("harmonic") else "relaxation"

    @property
    def noise_columns(self) -> dict[str, str]:
        """Columns of standard deviations by the keys that name them."""
        stated = {key: getattr(self, key) for key in ("sigma_pa", "sigma_n", "lateral_sigma")}
        return {key: value for key, value in stated.items() if isinstance(value, str)}

    @model_validator(mode="after")
    def _require_consistent(self) -> SpecimenSection:
        sigmas = ("relative_sigma",) if self.modulus == "harmonic" else ("sigma_pa", "sigma_n")
        excluded = NOT_OF_MODULI if self.modulus else frozenset()
        excluded |= {"sigma_pa", "window_s"} if self.modulus == "harmonic" else {"relative_sigma"}
        if more := self.model_fields_set & excluded:
            raise ValueError(
                f'found {", ".join(sorted(more))} with test = "{self.test}", which has no such key; '
                f"expected {' or '.join(sigmas[:1] if self.modulus else sigmas)} for its noise"
            )
        require_one(self, *sigmas)
        if self.shift and self.temperature_difference_k:
            raise ValueError(
                "found shift and temperature_difference_k; expected one of them, which shifts the "
                "relaxation times"
            )
        if self.sigma_n is not None and self.area_m2 is None:
            raise ValueError(
                "found sigma_n without area_m2; expected area_m2 too, because the noise of the "
                "stress is sigma_n / area_m2, or sigma_pa instead of sigma_n"
            )
        if self.window_s is not None and not self.window_s[0] < self.window_s[1]:
            raise ValueError(
                f"found window_s = {list(self.window_s)}; expected [start, end] with start < end"
            )
        return self


def deviation(prior: Prior) -> float:
    """Return the standard deviation that a prior states; 0 for "none"."""
    return 0.0 if prior == "none" else float(prior)
