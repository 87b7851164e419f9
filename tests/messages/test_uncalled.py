"""A method in place of its result is refused where it is stated."""

from __future__ import annotations

from dataclasses import replace

import pytest
from kit.problems import hung_cube

import collocation_sysid as cs

UNCALLED = {
    "nuisance": lambda: replace(hung_cube(), nuisance=cs.Nuisance.none),
    "markers": lambda: replace(hung_cube(), markers=cs.Markers.none),
    "poses": lambda: cs.Grasp([0, 1, 2], cs.PoseSequence.fixed),
}


@pytest.mark.parametrize("name", UNCALLED)
def test_a_method_that_was_not_called_is_refused(name):
    with pytest.raises(cs.InputError, match=name):
        UNCALLED[name]()
