"""Material tests of the public collection `hyperelastic_curves`, as experiments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..common.files import damage_refused, reason
from ..common.validated_classes import validated
from ..errors import InputError, require_among
from ..fem.laws.materials import Energy, Material
from ..recording import Experiment, Specimen
from .public_data import INSTALLATION, fetch

FILE = "data.h5"
# Unit of the stresses of each author [Pa].
UNITS_PA = {
    "Budday_2017": 1e3,
    "Katashima_2012": 1e3,
    "Kawabata_1981": 1e6,
    "Kawamura_2001": 1e6,
    "Meunier_2008": 1e6,
    "Treloar_1944": 1e6,
}
# Kinds of test by the beginning of their name, with the component of F that varies.
KINDS = {
    "UT": ("uniaxial", (0, 0)),
    "UC": ("uniaxial", (0, 0)),
    "ET": ("equibiaxial", (0, 0)),
    "PS": ("planar", (0, 0)),
    "BT": ("biaxial", (0, 0)),
    "SS": ("simple-shear", (0, 1)),
    "CSS": ("simple-shear", (0, 1)),
}
# Stresses along the two axes were read at different stretches.
LEFT_OUT = {"Katashima_2012": ("BT", "PS")}
# Noise that is assumed of the stresses, relative to the largest of a test.
RELATIVE_SIGMA = 0.01


@validated
def hyperelastic_curves(
    author: str,
    material: str | Energy | Material,
    *,
    tests: Sequence[str] | None = None,
    sigma_pa: float | None = None,
) -> list[Experiment]:
    """Return material tests of one author from the public collection `hyperelastic_curves`.

    A copy of the file (`fetch`) and the extra `datasets` are needed. Stretches or amounts of shear
    against engineering stresses; the units of the file are MPa, and kPa for Budday and Katashima.
    The names of the tests begin with their kind: UT and UC (uniaxial tension and compression), ET
    (equibiaxial), PS (planar), BT (biaxial, for example "BT_lambda_1d3" with a second stretch of
    1.3), SS (simple shear) and CSS (simple shear at an axial stretch, for example
    "CSS_corona_radiata_lambda_0d75").

    Source: repository Chongran-Zhao/Calibration-Hyperelasticity on GitHub, MIT licence; its author
    read the curves from these papers, which are to be cited:

    - Budday_2017, brain tissue, medians over donors: S. Budday et al., Mechanical characterization
      of human brain tissue, Acta Biomaterialia 48, 319–340 (2017).
    - Katashima_2012, a gel (only ET): T. Katashima et al., Strain energy density function of a
      near-ideal polymer network estimated by biaxial deformation of Tetra-PEG gel, Soft Matter 8,
      8217–8222 (2012).
    - Kawabata_1981, isoprene rubber: S. Kawabata et al., Macromolecules 14(1), 154–162 (1981).
    - Kawamura_2001, a silicone network: T. Kawamura et al., Multiaxial deformations of end-linked
      poly(dimethylsiloxane) networks, Macromolecules 34, 8252–8260 (2001).
    - Meunier_2008, unfilled silicone: L. Meunier et al., Mechanical experimental characterisation
      and numerical modelling of an unfilled silicone rubber, Polymer Testing 27, 765–777 (2008).
    - Treloar_1944, vulcanised rubber: L. R. G. Treloar, Stress-strain data for vulcanized rubber
      under various types of deformation, Rubber Chemistry and Technology 17(4), 813–825 (1944).

    Parameters
    ----------
    author : str
        Author and year, as in the list.
    material : str, Material or callable
        Material law, as of `Body`.
    tests : list of str, optional
        Names of tests; all by default.
    sigma_pa : float, optional
        Standard deviation of the stresses; the papers state none. By default 1 % of the largest
        stress of a test. Zero of the strain and area count as exact, since the tests of one material
        share them.

    Returns
    -------
    list of Experiment
        One for each test, in the order of `tests`, with the name of the test.

    Raises
    ------
    InputError
        For an unknown author or test, or if the file is not available.
    """
    require_among(author, UNITS_PA, where="author")
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            f"{FILE} is an HDF5 file, for which h5py is missing; expected {INSTALLATION}",
            where="dataset",
        ) from error
    file = fetch("hyperelastic_curves") / FILE
    remedy = "put a copy of the file there"
    try:
        opened = h5py.File(file)
    except OSError as error:
        raise InputError(f"the file is damaged ({reason(error)}); {remedy}", file) from error
    with opened as content, damage_refused(file.parent, FILE, remedy):
        groups: Any = content[author]
        known = [name for name in groups if name not in LEFT_OUT.get(author, ())]
        chosen = known if tests is None else [*tests]
        for name in chosen:
            require_among(name, known, where="tests")
        unit_pa = UNITS_PA[author]
        return [
            _specimen(
                name, groups[name]["F"][()], unit_pa * groups[name]["stress"][()], sigma_pa
            ).experiment(material, name)
            for name in chosen
        ]


def _specimen(name: str, gradients: Array, stresses_pa: Array, sigma_pa: float | None) -> Specimen:
    """Return the specimen of deformation gradients (T, 3, 3) and engineering stresses (T, 3, 3)."""
    kind = name.partition("_")[0]
    test, component = KINDS[kind]
    strain = gradients[:, *component] - float(component == (0, 0))
    stress_pa = stresses_pa[:, *component]
    others: dict[str, Any] = {}
    if test == "biaxial":
        others = {"second_strain": gradients[:, 1, 1] - 1}
    if test in ("biaxial", "planar") and stresses_pa[:, 1, 1].any():
        others["second_stress_pa"] = stresses_pa[:, 1, 1]
    if kind == "CSS":
        others["axial_stretch"] = float(gradients[0, 0, 0])
    sigma_pa = sigma_pa or RELATIVE_SIGMA * float(np.abs(stress_pa).max())
    return Specimen(
        test, strain, stress_pa, sigma_pa=sigma_pa, strain_zero=0.0, area_error=0.0, **others
    )
