"""What a search does not know of the branches of a memory: their order, and that a share without limit
is that of a liquid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..fem.laws.constants import SHARE, TAU, is_limitless
from ..methods.solution import Solution
from ..model.parameters import Parameters


def with_ascending_times(solution: Solution, stated: Parameters) -> Solution:
    """Return the solution with its branches exchanged such that their relaxation times ascend in the
    order of their names.

    Branches are exchanged whose constants are estimated with equal bounds and without guess and
    prior: the order of their names is all that was stated about them.
    """
    sources = {}
    for pairs in _alike_branches(solution, stated):
        values = solution.parameters
        ascending = sorted(pairs, key=lambda pair: values[pair[1]])
        for own, source in zip(pairs, ascending, strict=True):
            sources |= dict(zip(own, source, strict=True))
    if all(name == source for name, source in sources.items()):
        return solution
    before = solution.collocation.parameters
    items = {item.name: item for item in before.components}
    parameters = before.map_components(
        lambda item: replace(items[sources.get(item.name, item.name)], name=item.name)
    )
    coordinates = dict(zip((item.name for item in before.free), solution.q, strict=True))
    z = solution.z.copy()
    z[: len(coordinates)] = [
        coordinates[sources.get(item.name, item.name)] for item in parameters.free
    ]
    history = [
        replace(
            each,
            parameters={name: each.parameters[sources.get(name, name)] for name in each.parameters},
        )
        for each in solution.history
    ]
    collocation = solution.collocation.with_parameters(parameters)
    return replace(solution, collocation=collocation, z=z, history=history)


def without_limitless_shares(solution: Solution) -> Solution:
    """Return the solution with the shares of memory fixed that grew to their largest value: of a
    liquid the data determine E (1 + Σg), the instantaneous modulus, and neither factor.
    """
    collocation = solution.collocation
    values = solution.parameters
    is_fixed = [is_limitless(item.name, values[item.name]) for item in collocation.parameters.free]
    if not (any(is_fixed) and solution.status.converged):
        return solution
    names = [
        n.name for n, fixed in zip(collocation.parameters.free, is_fixed, strict=True) if fixed
    ]
    parameters = collocation.parameters.map_components(
        lambda item: (
            replace(item, guess=values[item.name], is_fixed=True) if item.name in names else item
        )
    )
    fixed = np.flatnonzero(is_fixed)
    return replace(
        solution,
        collocation=collocation.with_parameters(parameters),
        z=np.delete(solution.z, fixed),
    )


def _alike_branches(solution: Solution, stated: Parameters) -> Iterator[list[tuple[str, str]]]:
    """Yield the (share, relaxation time) names of branches that were stated alike, by region."""
    items = {item.name: item for item in stated.components}
    tied_to = {item.tied.to for item in stated.components if item.tied}
    regions: dict[str, list[tuple[str, str]]] = {}
    for transcription in solution.collocation.transcriptions:
        for part in transcription.body.parts:
            prefix = f"{part.name}." if part.name else ""
            regions[prefix] = [
                (f"{prefix}{each.name}.{SHARE.name}", f"{prefix}{each.name}.{TAU.name}")
                for each in part.prony
            ]
    for pairs in regions.values():
        groups: dict[tuple[object, ...], list[tuple[str, str]]] = {}
        for pair in pairs:
            own = [items[name] for name in pair if name in items]
            is_open = all(
                each.guess is None
                and each.prior is None
                and each.tied is None
                and not each.is_fixed
                and each.name not in tied_to
                for each in own
            )
            if len(own) == len(pair) and is_open:
                key = tuple((each.lower, each.upper, each.scale) for each in own)
                groups.setdefault(key, []).append(pair)
        yield from groups.values()
