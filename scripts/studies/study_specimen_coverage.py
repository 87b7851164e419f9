"""Coverage of the 95 % intervals of homogeneous specimens, over simulated twins.

Each twin draws noise, a zero of the strain for each test and an error of the area for each test
from their stated distributions. Intervals are statistical ones: the simulated material is neither
anisotropic nor drifting, so that the combined intervals would be too wide.

    python scripts study_specimen_coverage
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from script_arguments import make_parser
from studies import Intervals, count_coverage, statistical_intervals

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings

UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Number of samples per test, and standard deviations of stress [Pa] and lateral stretch.
SAMPLES = 20
SIGMA_PA = 2e3
LATERAL_SIGMA = 2e-3
# Initial guess over the true value.
GUESS_SHARE = 0.8


@dataclass(frozen=True)
class SpecimenCase:
    """Tests of one material."""

    name: str
    material: str
    truth: Mapping[str, float]
    free: tuple[str, ...]  # names of the constants that are estimated
    tests: tuple[str, ...]
    strains: tuple[float, float]  # first and last strain of each test
    has_lateral: bool = False  # whether the lateral stretch is measured


CASES = (
    SpecimenCase(
        "rubber: uniaxial, planar, equibiaxial",
        "mooney-rivlin",
        {"c10_pa": 1e5, "c01_pa": 2e4, "kappa_pa": 1e9},
        ("c10_pa", "c01_pa"),
        ("uniaxial", "planar", "equibiaxial"),
        (0.05, 1.5),
    ),
    SpecimenCase(
        "foam: compression with lateral stretch",
        "neo-hookean",
        {"young_pa": 5e4, "poisson": 0.25},
        ("young_pa", "poisson"),
        ("uniaxial",),
        (-0.02, -0.4),
        has_lateral=True,
    ),
    SpecimenCase(
        "rubber: simple shear and confined compression",
        "neo-hookean",
        {"young_pa": 2e5, "poisson": 0.45},
        ("young_pa", "poisson"),
        ("simple-shear", "confined"),
        (-0.01, -0.2),
    ),
)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument("--case", type=int, choices=range(len(CASES)), help="one of the cases")
    options = parser.parse_args()
    for case in CASES if options.case is None else CASES[options.case : options.case + 1]:
        rngs = map(np.random.default_rng, range(options.twins))
        twins = (([twin(case, test, rng) for test in case.tests], case.truth) for rng in rngs)
        coverage = count_coverage(twins, lambda tests, case=case: intervals(case, tests))
        print(f"{case.name}: {coverage.table()}\n", flush=True)


def intervals(case: SpecimenCase, tests: Sequence[cs.Experiment]) -> Intervals:
    """Return the statistical 95 % interval of each estimated constant."""
    free = {name: cs.Unknown(guess=GUESS_SHARE * case.truth[name]) for name in case.free}
    every = statistical_intervals(cs.Problem(tests, {**case.truth, **UNDAMPED, **free}))
    return {name: every[name] for name in case.free}


def twin(case: SpecimenCase, test: str, rng: np.random.Generator) -> cs.Experiment:
    """Return a test with noise, a random zero of the strain and a random error of the area."""
    strain = np.linspace(*case.strains, SAMPLES)
    zeros = np.zeros(SAMPLES)
    lateral: Any = 1 + zeros if case.has_lateral else None
    described = cs.Specimen(
        test, strain, zeros, SIGMA_PA, lateral_stretch=lateral, lateral_sigma=LATERAL_SIGMA
    )
    true_strain = strain + described.strain_zero * rng.normal()
    true_specimen = cs.Specimen(test, true_strain, zeros, SIGMA_PA, lateral_stretch=lateral)
    trajectory = cs.simulate(
        true_specimen.experiment(case.material, test), {**case.truth, **UNDAMPED}
    )
    area_factor = 1 + described.area_error * rng.normal()
    experiment = described.experiment(case.material, test)
    values = [
        (area_factor if gauge.unit == "Pa" else 1.0) * reading
        + gauge.sigma * rng.normal(size=reading.shape)
        for gauge, reading in zip(experiment.readings, trajectory.custom_sensor_values, strict=True)
    ]
    return with_readings(experiment, values)


if __name__ == "__main__":
    main()
