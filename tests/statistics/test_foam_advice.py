"""Laws that a misfit of a specimen advises to compare are those of its kind of material."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.kinds.specimen.concerns import as_specimen_concerns
from collocation_sysid.statistics.concerns import Concern

STRAIN = np.linspace(-0.4, 0.3, 15)


def advised(material: str, lateral_power: float | None = None) -> str:
    """Message on the misfit of a uniaxial test, with lateral stretches λ^power."""
    specimen = cs.Specimen("uniaxial", STRAIN, 1e4 * STRAIN, 10.0)
    if lateral_power is not None:
        specimen = replace(specimen, lateral_stretch=(1 + STRAIN) ** lateral_power)
    concerns = [Concern("noise/larger", data={"factor": 3.0, "stated": "sigma_m"})]
    return as_specimen_concerns(concerns, [specimen.experiment(material)])[0].message


@pytest.mark.parametrize(("material", "power"), [("hyperfoam-1", None), ("neo-hookean", -0.1)])
def test_foams_are_compared_with_laws_of_foams(material, power):
    message = advised(material, power)
    assert "hyperfoam-2" in message
    assert "yeoh" not in message
    assert "ogden" not in message


@pytest.mark.parametrize("power", [None, -0.48])
def test_rubbers_are_compared_with_laws_of_rubbers(power):
    message = advised("neo-hookean", power)
    assert "--materials neo-hookean,mooney-rivlin,yeoh,gent,ogden-2" in message


@pytest.mark.parametrize(
    ("law", "richer"), [("ogden-2", "ogden-3"), ("hyperfoam-2", "hyperfoam-3")]
)
def test_a_law_of_several_terms_is_compared_with_one_of_more_terms(law, richer):
    assert richer in advised(law)


@pytest.mark.parametrize(("largest", "is_advised"), [(0.04, False), (0.4, True)])
def test_laws_are_compared_where_they_can_differ(largest, is_advised):
    strain = np.linspace(0.004, largest, 7)
    pulled = cs.Specimen("uniaxial", strain, 1e4 * strain, 10.0).experiment(name="pull")
    concerns = [
        Concern("noise/larger", data={"factor": 4.8, "stated": "sigma_m"}),
        Concern(
            "noise/sensor",
            data={"marker": "pull/stress", "factor": 4.8, "stated": "sigma_pa", "count": 1},
        ),
    ]
    for each in as_specimen_concerns(concerns, [pulled]):
        assert "sigma_pa" in each.message
        assert ("compare laws" in each.message) is is_advised
