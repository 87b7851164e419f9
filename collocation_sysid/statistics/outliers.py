"""Single samples that have more of the residuals' power than all others of their marker together.

Such a sample spoils what the residuals tell: beside it all others look like white noise, however
much they hang together. It is named, and tests of correlation look at the others, as the fit has
left them.

Of n independent normal samples in k coordinates the share of one in the power is a Beta variable
with the parameters k/2 and (n − 1) k/2; the largest of n exceeds a share with n times the
probability of one at most (Cochran 1941, Grubbs 1950). Samples are set apart one by one as long as
one of the others spoils the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .distributions import beta_sf
from .linearised import FitBlock, LinearisedFit, Mask

# Probability that a sample of noise is named, of all of them.
RARE = 1e-4
# Share of its marker's power that a sample has at least.
MOST = 0.5
# More of a marker's samples than this share are no exceptions; of few samples none stands out.
EXCEPTIONS = 0.1
FEWEST = 4


@dataclass(frozen=True)
class Outlier:
    """One sample that spoils the rest.

    Attributes
    ----------
    series : str
        "swing/tip", the marker, or "press/force".
    sample : int
    t_s : float
    share : float
        Of the power of its marker's residuals.
    deviations : float
        Its residual over σ.
    first_relaxed : bool
        The first sample of a body with memory, which counts as relaxed there.
    """

    series: str
    sample: int
    t_s: float
    share: float
    deviations: float
    first_relaxed: bool

    @property
    def said(self) -> str:
        """What it does, and the remedy."""
        remedy = "leave it out, or set solver.huber"
        if self.first_relaxed:
            remedy = (
                "the body counts as relaxed at the first sample; let the recording begin before "
                "the load does, or leave the sample out"
            )
        return (
            f"the sample at t = {self.t_s:.4g} s, off by {self.deviations:.2g} sigma, alone has "
            f"{100 * self.share:.0f} % of the residuals' power: {remedy}"
        )


def set_apart(fit: LinearisedFit) -> tuple[LinearisedFit, tuple[Outlier, ...]]:
    """The fit without the samples that spoil the rest, and these; the same fit where none does."""
    blocks, found = [], []
    for block in fit.blocks:
        for marker in np.flatnonzero(block.present.any(axis=0)).tolist():
            allowed = max(1, int(EXCEPTIONS * block.present[:, marker].sum()))
            while allowed and (outlier := _outlier(block, marker, RARE / len(fit.blocks))):
                found.append(outlier)
                block, allowed = _without(block, marker, outlier.sample), allowed - 1
        blocks.append(block)
    return (replace(fit, blocks=tuple(blocks)), tuple(found)) if found else (fit, ())


def _outlier(block: FitBlock, marker: int, rare: float) -> Outlier | None:
    """The sample of a marker that spoils the rest; None where none does."""
    power = np.sum(block.residual[:, marker] ** 2, axis=1)
    count, sample = int(block.present[:, marker].sum()), int(power.argmax())
    share = float(power[sample] / max(power.sum(), 1e-300))
    freedom = int(block.seen[:, marker].sum()) / count / 2  # half the coordinates of a sample
    chance = count * block.present.shape[1] * beta_sf(share, freedom, (count - 1) * freedom)
    if count < FEWEST or share < MOST or chance > rare:
        return None
    return Outlier(
        f"{block.name}/{block.marker_names[marker]}",
        sample,
        float(block.t_s[sample]),
        share,
        float(np.sqrt(power[sample])),
        block.relaxed_first and sample == 0,
    )


def _without(block: FitBlock, marker: int, sample: int) -> FitBlock:
    kept: Mask = np.ones(block.present.shape, dtype=bool)
    kept[sample, marker] = False
    each = kept[..., None]
    return replace(
        block,
        present=block.present & kept,
        residual=block.residual * each,
        slope=block.slope * each[..., None],
        misfit=None if block.misfit is None else block.misfit * each,
        components=block.seen & each,
    )
