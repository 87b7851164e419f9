"""Methods that solve a `Collocation` and return a `Solution`, by name."""

from __future__ import annotations

from functools import partial

from .augmented_lagrangian import AugmentedLagrangianOptions
from .augmented_lagrangian import solve as augmented_lagrangian
from .casadi_nlp import methods as casadi_methods
from .continuation import ContinuationOptions
from .continuation import solve as continuation
from .interior_point import InteriorPointOptions
from .interior_point import solve as interior_point
from .method import Method
from .penalty import PenaltyOptions
from .penalty import solve as penalty
from .reduced_space import ReducedSpaceOptions
from .reduced_space import solve as reduced_space
from .shooting import ShootingOptions
from .shooting import solve as shooting

METHODS: dict[str, Method] = {
    "interior-point": Method(interior_point, InteriorPointOptions),
    "reduced-space": Method(reduced_space, ReducedSpaceOptions),
    "penalty": Method(penalty, PenaltyOptions),
    "augmented-lagrangian": Method(augmented_lagrangian, AugmentedLagrangianOptions),
    "shooting": Method(shooting, ShootingOptions),
}
METHODS |= casadi_methods()
METHODS["continuation"] = Method(partial(continuation, methods=METHODS), ContinuationOptions)
