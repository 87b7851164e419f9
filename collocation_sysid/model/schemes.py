"""Time-stepping schemes as tables of stencils.

On a grid x_0, x_1, … with step Δt the force is evaluated once per step,

    F_k = f(ξ_k, ν_k; θ) + f_ext,   ξ_k = Σ_i p_i x_{k−i},   ν_k = Σ_i q_i x_{k−i} / Δt,

and row t of the constraints reads

    c_t = Σ_j w_j F_{t−j} − M (Σ_i s_i x_{t−i} + r Δt v_0) / Δt² = 0.

The first rows have stencils of their own, made from the start velocity v_0 and the terms that
exist; r is not zero only there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..errors import InputError

# Steps from sample to sample; whoever asks for more has slipped.
MOST_STEPS = 10_000


@dataclass(frozen=True)
class Stencil:
    """One row: evaluation point (p, q), force weights w, inertia s and start velocity r."""

    p: tuple[float, ...]
    q: tuple[float, ...]
    w: tuple[float, ...]
    s: tuple[float, ...]
    r: float = 0.0


@dataclass(frozen=True)
class Scheme:
    """A table entry: the stencil of regular rows and those of rows 1, 2, … of the start."""

    name: str
    order: int
    regular: Stencil
    start: tuple[Stencil, ...]

    def stencil(self, row: int) -> Stencil:
        """The stencil of row t >= 1; row 0, where it exists, is the static problem."""
        if row == 0:
            return STATIC
        return self.start[row - 1] if row <= len(self.start) else self.regular

    @property
    def is_midpoint(self) -> bool:
        """Whether forces are evaluated half way between the last two states, with their difference.

        Then ξ ∓ Δt ν/2 are these states, and a force may be averaged over the step.
        """
        stencils = (self.regular, *self.start)
        return all((each.p, each.q) == ((0.5, 0.5), (1.0, -1.0)) for each in stencils)

    @property
    def reach(self) -> int:
        """Largest lag l with ∂c_t/∂x_{t−l} ≠ 0."""
        lags = []
        for stencil in (self.regular, *self.start):
            points = max(len(stencil.p), len(stencil.q))
            lags.append(max(len(stencil.w) + points - 2, len(stencil.s) - 1))
        return max(lags)


STATIC = Stencil(p=(1.0,), q=(0.0,), w=(1.0,), s=(0.0,))
# Every sample is an equilibrium of its own: that of static experiments, whatever the others'.
QUASI_STATIC = Scheme("quasi-static", 1, STATIC, ())
# What rubs there feels how far it has come since the sample before.
SLIDING = Scheme("sliding", 1, Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(0.0,)), ())

BACKWARD_EULER = Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(1.0, -2.0, 1.0))
_FIRST_STEP = Stencil(p=(1.0,), q=(1.0, -1.0), w=(1.0,), s=(1.0, -1.0), r=-1.0)
MIDPOINT = Stencil(p=(0.5, 0.5), q=(1.0, -1.0), w=(0.5, 0.5), s=(1.0, -2.0, 1.0))
_BDF2_VELOCITY = (1.5, -2.0, 0.5)

SCHEMES: dict[str, Scheme] = {
    # The paper's. Damps a mode of angular frequency ω with the ratio ωΔt/2.
    "backward-euler": Scheme("backward-euler", 1, BACKWARD_EULER, (_FIRST_STEP,)),
    # Variational midpoint rule (Marsden & West 2001, sec. 2.6): no numerical damping.
    "midpoint": Scheme(
        "midpoint",
        2,
        MIDPOINT,
        (Stencil(p=(0.5, 0.5), q=(1.0, -1.0), w=(0.5,), s=(1.0, -1.0), r=-1.0),),
    ),
    # BDF2 in velocity and acceleration; v_1 is backward Euler's, v_0 is given, and rows 2 and 3
    # are a_t = (3 v_t − 4 v_{t−1} + v_{t−2}) / 2Δt with those velocities put in.
    "bdf2": Scheme(
        "bdf2",
        2,
        Stencil(p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -24 / 4, 22 / 4, -8 / 4, 1 / 4)),
        (
            _FIRST_STEP,
            Stencil(p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -20 / 4, 11 / 4), r=0.5),
            Stencil(p=(1.0,), q=_BDF2_VELOCITY, w=(1.0,), s=(9 / 4, -24 / 4, 21 / 4, -6 / 4)),
        ),
    ),
}


def as_scheme(given: str | Scheme, start_rule: str = "standard") -> Scheme:
    """A scheme from a name in `SCHEMES` or itself, with the start rule of its first step.

    Parameters
    ----------
    given : str or Scheme
    start_rule : {"standard", "paper"}
        "paper" drops the inertia of the first step (a = 0); only for backward Euler.

    Raises
    ------
    InputError
        For unknown names and combinations.
    """
    if isinstance(given, str) and given not in SCHEMES:
        raise InputError(f"no scheme {given!r}; available: {', '.join(SCHEMES)}")
    scheme = SCHEMES[given] if isinstance(given, str) else given
    if start_rule == "standard":
        return scheme
    if start_rule != "paper":
        raise InputError(f"no start rule {start_rule!r}; available: standard, paper")
    if scheme != SCHEMES["backward-euler"]:
        raise InputError(
            f"start rule 'paper' belongs to scheme 'backward-euler', not {scheme.name!r}"
        )
    return replace(scheme, start=(replace(_FIRST_STEP, s=(0.0, 0.0), r=0.0),))
