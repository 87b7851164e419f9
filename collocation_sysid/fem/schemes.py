"""Time-stepping schemes as tables of stencils.

Use `as_scheme` to get a scheme by name. On a grid x_0, x_1, … with step Δt the force is evaluated
once per step,

    F_k = f(ξ_k, ν_k; θ) + f_ext,   ξ_k = Σ_i p_i x_{k−i},   ν_k = Σ_i q_i x_{k−i} / Δt,

and row t of the constraints reads

    c_t = Σ_j w_j F_{t−j} − M (Σ_i s_i x_{t−i} + r Δt v_0) / Δt² = 0.

The first rows have separate stencils, because x_{t−i} does not exist for t < i; these stencils use
the start velocity v_0, so r is nonzero only there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne, Finite
from ..errors import InputError

# Largest accepted number of steps from sample to sample; a larger one is a typing error.
MOST_STEPS = 10_000


@validated
@dataclass(frozen=True)
class Stencil:
    """Coefficients of one row of the equations of motion.

    Attributes
    ----------
    p : tuple of float
        Weights of x_{t−i} in the position ξ at which the force is evaluated.
    q : tuple of float
        Weights of x_{t−i} / Δt in the velocity ν at which the force is evaluated.
    w : tuple of float
        Weights of the forces F_{t−j}.
    s : tuple of float
        Weights of x_{t−i} / Δt² in the acceleration.
    r : float
        Weight of the start velocity v_0 / Δt in the acceleration.
    """

    p: tuple[Finite, ...]
    q: tuple[Finite, ...]
    w: tuple[Finite, ...]
    s: tuple[Finite, ...]
    r: Finite = 0.0


@validated
@dataclass(frozen=True)
class Scheme:
    """Time-stepping scheme: a regular stencil and separate stencils for the first rows.

    Attributes
    ----------
    name : str
    order : int
        Order of accuracy in the time step.
    regular : Stencil
        Stencil of all rows after the start.
    start : tuple of Stencil
        Stencils of rows 1, 2, ….
    """

    name: str
    order: AtLeastOne
    regular: Stencil
    start: tuple[Stencil, ...]

    def stencil(self, row: int) -> Stencil:
        """Return the stencil of a row, given by its index from 0.

        Row 0, which exists where an experiment starts in equilibrium, has the stencil of statics;
        rows after those of `start` have the regular one.
        """
        if row == 0:
            return STATIC
        return self.start[row - 1] if row <= len(self.start) else self.regular

    def is_midpoint(self) -> bool:
        """Return whether `regular` and all stencils of `start` evaluate forces half way between the
        last two states, with the velocity from their difference.

        The last two states are then ξ ∓ Δt ν/2, and a force may be averaged over the step.
        """
        stencils = (self.regular, *self.start)
        return all((each.p, each.q) == ((0.5, 0.5), (1.0, -1.0)) for each in stencils)

    @property
    def largest_lag(self) -> int:
        """Largest lag l with ∂c_t/∂x_{t−l} ≠ 0, in time steps."""
        lags = []
        for stencil in (self.regular, *self.start):
            points = max(len(stencil.p), len(stencil.q))
            lags.append(max(len(stencil.w) + points - 2, len(stencil.s) - 1))
        return max(lags)


STATIC = Stencil(p=(1.0,), q=(0.0,), w=(1.0,), s=(0.0,))
# Scheme of static experiments: every sample is an equilibrium, independent of the others.
QUASI_STATIC = Scheme("quasi-static", 1, regular=STATIC, start=())
# Scheme of static experiments with friction: ν is the displacement since the previous sample.
SLIDING = Scheme(
    "sliding", 1, regular=Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(0.0,)), start=()
)

BACKWARD_EULER = Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(1.0, -2.0, 1.0))
_FIRST_STEP = Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(1.0, -1.0), r=-1.0)
MIDPOINT = Stencil(p=(0.5, 0.5), q=(1.0, -1.0), w=(0.5, 0.5), s=(1.0, -2.0, 1.0))
# Weights of the latest three positions in the velocity by BDF2, over the time step.
_BDF2_VELOCITY = (1.5, -2.0, 0.5)

SCHEMES: dict[str, Scheme] = {
    # The scheme of the paper. It damps a mode of angular frequency ω with the ratio ωΔt/2.
    "backward-euler": Scheme("backward-euler", 1, regular=BACKWARD_EULER, start=(_FIRST_STEP,)),
    # Variational midpoint rule (Marsden & West 2001, sec. 2.6): no numerical damping.
    "midpoint": Scheme(
        "midpoint",
        2,
        regular=MIDPOINT,
        start=(Stencil(p=(0.5, 0.5), q=(1.0, -1.0), w=(0.5,), s=(1.0, -1.0), r=-1.0),),
    ),
    # BDF2 in velocity and acceleration; v_1 is that of backward Euler, v_0 is given, and rows 2
    # and 3 are a_t = (3 v_t − 4 v_{t−1} + v_{t−2}) / 2Δt with these velocities inserted.
    "bdf2": Scheme(
        "bdf2",
        2,
        regular=Stencil(
            p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -24 / 4, 22 / 4, -8 / 4, 1 / 4)
        ),
        start=(
            _FIRST_STEP,
            Stencil(p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -20 / 4, 11 / 4), r=0.5),
            Stencil(p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -24 / 4, 21 / 4, -6 / 4)),
        ),
    ),
}


def as_scheme(scheme_or_name: str | Scheme, start_rule: str = "standard") -> Scheme:
    """Return a scheme by its name in `SCHEMES`, or the given scheme, with the start rule applied.

    Parameters
    ----------
    start_rule : {"standard", "paper"}
        "standard": the scheme as it is. "paper" drops the inertia of the first step (a = 0); for
        backward Euler only.

    Raises
    ------
    InputError
        For an unknown scheme or start rule, or "paper" with another scheme than backward Euler.
    """
    if isinstance(scheme_or_name, str) and scheme_or_name not in SCHEMES:
        raise InputError(f"no scheme {scheme_or_name!r}; available: {', '.join(SCHEMES)}")
    scheme = SCHEMES[scheme_or_name] if isinstance(scheme_or_name, str) else scheme_or_name
    if not isinstance(scheme, Scheme):
        raise InputError(f"scheme is {scheme!r}; expected one of {', '.join(SCHEMES)}, or a Scheme")
    if start_rule == "standard":
        return scheme
    if start_rule != "paper":
        raise InputError(f"no start rule {start_rule!r}; expected one of standard, paper")
    if scheme != SCHEMES["backward-euler"]:
        raise InputError(
            f"found start rule 'paper' and scheme {scheme.name!r}; expected start rule 'standard', "
            "or scheme 'backward-euler'"
        )
    return replace(scheme, start=(replace(_FIRST_STEP, s=(0.0, 0.0), r=0.0),))
