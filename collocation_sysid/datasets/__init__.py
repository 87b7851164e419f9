"""Datasets by name: measured rubber from the literature, the project's simulated recordings, and
public collections.

A dataset is a folder with files; `fetch` returns it. Each function returns experiments that can be
solved with `Problem`. Datasets of the package (`DATASETS`) have a problem file, too, which
``collocation-sysid new NAME --dataset DATASET`` copies and `read_problem` reads. Public collections
are downloaded at their first use.

>>> import collocation_sysid as cs
>>> tests = cs.datasets.kawabata_1981("mooney-rivlin")  # doctest: +SKIP
>>> problem = cs.Problem(tests, {"c10_pa": cs.Unknown(), "c01_pa": cs.Unknown(),  # doctest: +SKIP
...     "kappa_pa": 1e9})
>>> cs.run(problem).parameters                          # doctest: +SKIP
"""

from __future__ import annotations

from typing import Any, Literal, get_args

from ..common.time_dependence import at_times, values_over_time
from ..common.validated_classes import validated
from ..errors import InputError
from ..fem.laws.materials import Energy, Material
from ..recording import Experiment, Specimen
from ..recording.specimen_files import SpecimenLayout, read_specimen
from .files import DATASETS, dataset_file, read_problem
from .hyperelastic_curves import hyperelastic_curves
from .public_data import fetch

__all__ = [
    "DATASETS",
    "diani",
    "fetch",
    "foam_cylinder",
    "hyperelastic_curves",
    "kawabata_1981",
    "laid_block",
    "noisy_cylinder",
    "poked_block",
    "read_problem",
    "table1",
    "treloar_1944",
    "wrist_sensor",
]

# Noise that is assumed of the stresses [Pa]: the publications state none.
KAWABATA_SIGMA_PA = 1e4
TRELOAR_SIGMA_PA = 2e4
DIANI_SIGMA_PA = 2e4
KawabataTest = Literal["uniaxial", "equibiaxial", "planar", "biaxial"]
KAWABATA_TESTS = get_args(KawabataTest)

MaterialLaw = str | Energy | Material


@validated
def kawabata_1981(
    material: MaterialLaw = "ogden-3",
    *,
    tests: tuple[KawabataTest, ...] = KAWABATA_TESTS[:3],
    largest_stretch: float | None = None,
) -> list[Experiment]:
    """Return biaxial tension of an isoprene rubber vulcanisate at stretches up to 3.7.

    Stretches and engineering stresses, one experiment for each kind of test, in the order of
    `tests`. Values of the file: MPa. The standard deviation of the stresses, 0.01 MPa, is an
    assumption; zero of the strain and area count as exact, since one sheet and one instrument gave
    all tests.

    Source: S. Kawabata, M. Matsuda, K. Tei, H. Kawai, Experimental survey of the strain energy
    density function of isoprene rubber vulcanizate, Macromolecules 14(1), 154–162 (1981). Numbers
    from Hyperelastics.jl (TRACER Lab at Liberty University), MIT licence.

    Parameters
    ----------
    material : str, Material or callable
        Material law, as of `Body`.
    tests : tuple of str
        Some of "uniaxial", "equibiaxial", "planar" (with the stress along the fixed width), and
        "biaxial", all other pairs of stretches. The first three by default.
    largest_stretch : float, optional
        Largest stretch of the samples to use, along either axis; None for all.

    Raises
    ------
    InputError
        For an unknown test or material.
    """
    return [
        _rubber(
            "kawabata_1981",
            test,
            material=material,
            test=test,
            sigma_pa=KAWABATA_SIGMA_PA,
            largest_stretch=largest_stretch,
            is_exact=True,
        )
        for test in tests
    ]


@validated
def treloar_1944(
    material: MaterialLaw = "gent", *, largest_stretch: float | None = None
) -> list[Experiment]:
    """Return uniaxial tension of vulcanised rubber (8 % S) at 20 °C at stretches up to 7.6, a list
    of one experiment.

    Stretch and engineering stress. Values of the file: MPa, converted from kgf/cm². The standard
    deviation of the stresses, 0.02 MPa, is an assumption.

    Source: L. R. G. Treloar, Stress-strain data for vulcanized rubber under various types of
    deformation, Rubber Chemistry and Technology 17(4), 813–825 (1944). Numbers from
    Hyperelastics.jl (TRACER Lab at Liberty University), MIT licence.

    Parameters
    ----------
    material : str, Material or callable
        Material law, as of `Body`.
    largest_stretch : float, optional
        Largest stretch of the samples to use; None for all.

    Raises
    ------
    InputError
        For an unknown material.
    """
    return [
        _rubber(
            "treloar_1944",
            "uniaxial",
            material=material,
            test="uniaxial",
            sigma_pa=TRELOAR_SIGMA_PA,
            largest_stretch=largest_stretch,
        )
    ]


@validated
def diani(
    material: MaterialLaw = "yeoh", *, largest_stretch: float | None = None
) -> list[Experiment]:
    """Return uniaxial tension of calendered rubber up to a stretch of 2.4: an experiment along the
    calendering direction, then one across.

    The rubber is anisotropic and softens in its first cycles (Mullins effect). Stretch and
    engineering stress; values of the file: MPa. That the stress is engineering follows from its use
    in the source. The standard deviation of the stresses, 0.02 MPa, is an assumption.

    Source: data of J. Diani and co-workers as in Hyperelastics.jl (TRACER Lab at Liberty
    University), MIT licence.

    Parameters
    ----------
    material : str, Material or callable
        Material law, as of `Body`.
    largest_stretch : float, optional
        Largest stretch of the samples to use; None for all.

    Raises
    ------
    InputError
        For an unknown material.
    """
    return [
        _rubber(
            "diani",
            direction,
            material=material,
            test="uniaxial",
            sigma_pa=DIANI_SIGMA_PA,
            largest_stretch=largest_stretch,
        )
        for direction in ("calendering", "transverse")
    ]


def foam_cylinder() -> list[Experiment]:
    """Return a simulated swing of a foam cylinder, with places of the markers unknown.

    Simulated with λ = 800 Pa, μ = 600 Pa, γ_r = 6 ms and γ_m = 1.5 1/s (E = 1543 Pa, ν = 0.286) and
    0.5 mm of noise. Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("foam_cylinder").experiments)


def laid_block() -> list[Experiment]:
    """Return a simulated foam block that a gripper sets on a plate and lets go.

    Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("laid_block").experiments)


def noisy_cylinder() -> list[Experiment]:
    """Return a simulated foam cylinder under cameras that lose, swap and misplace markers.

    Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("noisy_cylinder").experiments)


def poked_block() -> list[Experiment]:
    """Return a simulated gel block poked at twelve places, of which only the force is measured.

    Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("poked_block").experiments)


def table1() -> list[Experiment]:
    """Return the simulated cylinder of the paper's Table I with a motion of this project's own.

    Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("table1").experiments)


def wrist_sensor() -> list[Experiment]:
    """Return a simulated swing of a block in a hand with a force–torque sensor.

    Units: SI. Source and licence: this project, MIT; cite the software.
    """
    return list(read_problem("wrist_sensor").experiments)


def _rubber(
    dataset: str,
    name: str,
    material: MaterialLaw,
    *,
    test: str,
    sigma_pa: float,
    largest_stretch: float | None = None,
    is_exact: bool = False,
) -> Experiment:
    file = dataset_file(dataset, f"{name}.csv")
    table = read_specimen(file, SpecimenLayout(test=test, columns={}))
    limit = float("inf") if largest_stretch is None else largest_stretch
    largest = (
        table.strain if table.second_strain is None else table.strain.clip(min=table.second_strain)
    )
    if not (1 + largest <= limit).any():
        raise InputError(
            f"largest_stretch = {limit:g}; expected at least {1 + largest.min():.4g}, the smallest "
            f"stretch of '{name}' of {dataset}"
        )
    rows = values_over_time(at_times(table, 1 + largest <= limit))
    stated: dict[str, Any] = {name: value for name, value in rows.items() if value is not None}
    stated["sigma_pa"] = sigma_pa
    if is_exact:
        stated |= {"strain_zero": 0.0, "area_error": 0.0}
    specimen = Specimen(test, **stated)
    return specimen.experiment(material, name)
