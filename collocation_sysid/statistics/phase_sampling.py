"""Two-phase fields: posterior of which elements belong to an inclusion, by linearised measurements.

With the residuals linear in parameters p and in the logarithm z_e of a constant in every element,
and z_e = s h_e for phases h ∈ {0, 1}ᴱ and the logarithm s of the contrast, the posterior is

    −2 ln π(h, s, p) = ‖r + S_p δp + S_z (s h − z₀)‖²/T + (s − m)²/A² + priors of p − 2 ln π(h),

with the Potts prior π(h) of `potts_prior`, whose constants are sampled too. T is the lack of fit,
at least one: by how much χ² exceeds that of the smooth field, per mode that the smooth field
determines. It is one if two phases describe the body and the right ones are found.

Given h, p and s are normal, so that both are integrated out: with N and c from the normal equations
after the elimination of p,

    −2 ln π(h) = −(hᵀc + m/A²)²/(hᵀN h + 1/A²) + ln(hᵀN h + 1/A²) − 2 ln π_Potts(h).

Sampling s and h in turn instead would not move along the direction in which a smaller inclusion
with a larger contrast fits as well: intervals would be several times too narrow. Phases start at a
total-variation estimate of z, divided into two classes (Otsu 1979), and are changed one element at
a time by locally balanced proposals (Zanella 2020). A modal level set, ln c = s H(φ) with a smooth
step H and a normal φ, was tried: its posterior mode has H near one half everywhere and several
times the contrast (10 for 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..fem.meshes.mesh import TetMesh
from .potts_prior import PottsConstants, PottsHyperprior


@dataclass(frozen=True)
class SamplerSettings:
    """Constants of the sampler."""

    # Prior of the constants of the Potts prior.
    hyperprior: PottsHyperprior = field(default_factory=PottsHyperprior)
    steps_per_element: int = 10  # proposals per element and chain; the first quarter is discarded
    least_steps: int = 4000  # fewest proposals of a chain
    chains: int = 8  # chains, at least three, which are computed together
    # Largest ratio of the volume of the inclusion at the start of a chain to that of the estimate
    # from which chains start, and of this to the smallest. Inclusions of twice the volume and about
    # half the difference of the constants deform the body in nearly the same way.
    dispersion: float = 2.0
    steps_per_draw: int = 400  # proposals between draws of the constants of the Potts prior
    steps_per_sample: int = 20  # proposals between stored samples
    # Weight of the total variation of z per face at the start, in units of −2 ln π.
    total_variation: float = 1.0
    smallest_jump: float = 0.02  # differences of z across a face that the start does not sharpen
    sharpenings: int = 8  # reweighted least-squares solves of the start
    # Limit of the exponents of the proposals' weights, against overflow.
    largest_exponent: float = 30.0


USUAL = SamplerSettings()


@dataclass(frozen=True, eq=False)
class InternalFaces:
    """Faces between two elements."""

    pairs: Index  # (F, 2): indices of the elements on both sides
    weights: Array  # (F,): area over the mean area
    element_count: int  # number E of elements

    @classmethod
    def from_mesh(cls, mesh: TetMesh, cells: Index) -> InternalFaces:
        """Find the faces between some elements of a mesh.

        Parameters
        ----------
        cells : (E,) array
            Indices of the elements; `pairs` has indices into this array. Faces to other elements
            are left out.
        """
        corners = mesh.tetrahedra[cells]
        triples = np.sort(corners[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
        cell_of_face = np.repeat(np.arange(len(cells)), 4)
        all_triples = triples.reshape(-1, 3)
        order = np.lexsort(all_triples.T)
        same = (all_triples[order[1:]] == all_triples[order[:-1]]).all(axis=1)
        first = order[:-1][same]
        second = order[1:][same]
        a, b, c = mesh.points_m[all_triples[first]].swapaxes(0, 1)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        return cls(
            np.column_stack([cell_of_face[first], cell_of_face[second]]),
            areas / areas.mean(),
            element_count=len(cells),
        )

    def build_adjacency(self) -> sp.csr_array:
        """Return the symmetric sparse matrix (E, E) of the weights of the faces between elements,
        zero where there is no face.
        """
        i, j = self.pairs.T
        both = (np.r_[self.weights, self.weights], (np.r_[i, j], np.r_[j, i]))
        return sp.csr_array(both, shape=(self.element_count, self.element_count))

    def build_jump_operator(self) -> sp.csr_array:
        """Return the sparse matrix (F, E) from values in elements to their jump across each face:
        the value of the first element of the pair less that of the second.
        """
        faces = np.arange(len(self.pairs))
        ends = np.r_[faces, faces], self.pairs.T.ravel()
        signs = np.repeat([1.0, -1.0], len(faces))
        return sp.csr_array((signs, ends), shape=(len(faces), self.element_count))


@dataclass(frozen=True, eq=False)
class ElementInformation:
    """Normal equations of the linearised measurements, by changes of p and of z."""

    of_p: Array  # (p, p): S_pᵀS_p / T and the information of the priors
    mixed: Array  # (E, p): S_zᵀS_p / T
    of_z: Array  # (E, E): S_zᵀS_z / T
    score_p: Array  # (p,): S_pᵀr / T and the score of the priors
    score_z: Array  # (E,): S_zᵀr / T
    base: Array  # (E,): expansion point z₀
    deviation: float  # prior standard deviation A of s
    mean: float = 0.0  # prior mean m of s

    @cached_property
    def covariance_p(self) -> Array:
        """Pseudo-inverse (p, p) of the information about p at given z."""
        return np.asarray(np.linalg.pinv(self.of_p, hermitian=True), float)

    @cached_property
    def eliminated(self) -> tuple[Array, Array]:
        """Information N (E, E) about z after the elimination of p, and the score (E,) at z₀."""
        normal = self.of_z - self.mixed @ self.covariance_p @ self.mixed.T
        score = self.score_z - self.mixed @ (self.covariance_p @ self.score_p)
        return normal, score

    def mean_changes(self, logarithms: Array) -> Array:
        """Return the means (K, p) of δp given logarithms z (K, E)."""
        scores = self.score_p + (logarithms - self.base) @ self.mixed
        return -scores @ self.covariance_p


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Samples of C chains, k of each."""

    phases: NDArray[np.int8]  # (k, C, E): phases, 0 or 1
    contrasts: Array  # (k, C): logarithms s of the contrast
    means: Array  # (k, C): means of s given the phases
    constants: PottsConstants  # constants of the Potts prior, (k, C) each
    accepted: float  # share of accepted proposals

    @property
    def probability(self) -> Array:
        """Probability (E,) of phase 1 in each element."""
        return self.phases.mean(axis=(0, 1))

    @property
    def scale_reduction(self) -> float:
        """Potential scale reduction of s (Gelman and Rubin 1992): about 1 if all chains
        sample the same distribution; infinite if no chain moves.
        """
        within = self.contrasts.var(axis=0, ddof=1).mean()
        between = self.contrasts.mean(axis=0).var(ddof=1)
        return float(np.sqrt(1 + between / within)) if within > 0 else np.inf


def initial_phases(
    data: ElementInformation,
    faces: InternalFaces,
    volumes_m3: Array,
    settings: SamplerSettings = USUAL,
) -> Array:
    """Return initial phases (C, E) of 0 and 1 for each chain, from the total-variation estimate of
    z, divided into two classes by Otsu's threshold.

    The class of smaller volume is the inclusion, phase 1. That is the start of the first chain; the
    inclusions of the others have from 1/`SamplerSettings.dispersion` to `dispersion` times its
    volume: over-dispersed starts, so that differences between the chains show whether they have
    converged.

    Parameters
    ----------
    data : ElementInformation
        Normal equations.
    faces : InternalFaces
        Faces between elements.
    volumes_m3 : (E,) array
        Volumes of the elements [m³].
    settings : SamplerSettings
        Constants of the algorithm.
    """
    z = _total_variation_estimate(data, faces, settings)
    above = z >= _class_threshold(z, volumes_m3)
    total_m3 = volumes_m3.sum()
    is_upper = bool(volumes_m3[above].sum() <= total_m3 / 2)
    inclusion = above if is_upper else ~above
    order = np.argsort(-z if is_upper else z, kind="stable")
    enclosed_m3 = np.cumsum(volumes_m3[order])
    factors = np.geomspace(1 / settings.dispersion, settings.dispersion, settings.chains - 1)
    phases = np.zeros((settings.chains, len(z)))
    phases[0] = inclusion
    for phase, factor in zip(phases[1:], factors, strict=True):
        volume_m3 = min(factor * volumes_m3[inclusion].sum(), total_m3 / 2)
        count = max(1, int(np.searchsorted(enclosed_m3, volume_m3)))
        phase[order[:count]] = 1.0
    return phases


def _total_variation_estimate(
    data: ElementInformation, faces: InternalFaces, settings: SamplerSettings
) -> Array:
    """Return z (E,) of least squares and least total variation, p eliminated."""
    normal, score = data.eliminated
    jumps = faces.build_jump_operator()
    z = data.base
    for _ in range(settings.sharpenings):
        smoothed = np.sqrt((jumps @ z) ** 2 + settings.smallest_jump**2)
        weights = settings.total_variation * faces.weights / smoothed
        prior = (jumps.T @ sp.diags_array(weights) @ jumps).toarray()
        # No measurement tells the mean of z, which p has too.
        prior[np.diag_indices_from(prior)] += 1e-9 * np.trace(prior) / len(prior)
        z = np.linalg.solve(normal + prior, normal @ data.base - score)
    return z


def _class_threshold(values: Array, weights: Array) -> float:
    """Return the threshold of least weighted variance within two classes (Otsu)."""
    order = np.argsort(values)
    sorted_values = values[order]
    weight = np.cumsum(weights[order])
    moment = np.cumsum(weights[order] * sorted_values)
    below = moment[:-1] ** 2 / weight[:-1]
    above = (moment[-1] - moment[:-1]) ** 2 / (weight[-1] - weight[:-1])
    return float(sorted_values[1:][np.argmax(below + above)])


def sample_phases(
    data: ElementInformation,
    faces: InternalFaces,
    start: Array,
    *,
    settings: SamplerSettings = USUAL,
    constants: PottsConstants | None = None,
    seed: int = 0,
) -> PosteriorDraws:
    """Draw phases and contrast from their posterior, by several chains with the parameters p
    integrated out.

    The same arguments give the same samples.

    Parameters
    ----------
    data : ElementInformation
        Normal equations.
    faces : InternalFaces
        Faces between elements.
    start : (E,) or (C, E) array
        Initial phases, 0 or 1, of all chains or of each; not modified.
    settings : SamplerSettings
        Constants of the sampler.
    constants : PottsConstants, optional
        Given constants of the Potts prior, (C,) each; None samples them.
    seed : int
        Seed of the random numbers.

    Notes
    -----
    Phases flip one at a time: element e is proposed with a probability proportional to the root of
    the ratio of posteriors with and without the flip (locally balanced), and accepted by Metropolis
    and Hastings.
    """
    rng = np.random.default_rng(seed)
    steps = max(settings.least_steps, settings.steps_per_element * faces.element_count)
    chains = _Chains(
        data,
        faces,
        start=np.broadcast_to(start, (settings.chains, faces.element_count)),
        constants=constants,
        largest_exponent=settings.largest_exponent,
    )
    phases: list[NDArray[np.int8]] = []
    contrasts: list[Array] = []
    means: list[Array] = []
    strengths: list[PottsConstants] = []
    accepted = 0.0
    for step in range(steps):
        if constants is None and step % settings.steps_per_draw == 0:
            chains.draw_constants(settings.hyperprior, rng)
        accepted += chains.propose(rng)
        if step >= steps // 4 and step % settings.steps_per_sample == 0:
            phases.append(chains.phases.astype(np.int8))
            contrasts.append(chains.draw_contrasts(rng))
            means.append(chains.estimate_mean_contrasts())
            strengths.append(chains.constants)
    return PosteriorDraws(
        phases=np.array(phases),
        contrasts=np.array(contrasts),
        means=np.array(means),
        constants=PottsConstants(
            np.array([each.face_nats for each in strengths]),
            element_nats=np.array([each.element_nats for each in strengths]),
        ),
        accepted=accepted / steps,
    )


class _Chains:
    """State of C chains: their phases, and what the energies of all flips follow from.

    Parameters
    ----------
    data : ElementInformation
        Normal equations.
    faces : InternalFaces
        Faces between elements.
    start : (C, E) array
        Initial phases; copied.
    constants : PottsConstants or None
        Constants of the Potts prior; None starts with the means of the usual hyperprior.
    largest_exponent : float
        Limit of the exponents of the proposals' weights.

    Attributes
    ----------
    phases : (C, E) array
        Present phases, 0.0 or 1.0.
    constants : PottsConstants
        Present constants of the Potts prior, (C,) each.
    """

    def __init__(
        self,
        data: ElementInformation,
        faces: InternalFaces,
        *,
        start: Array,
        constants: PottsConstants | None,
        largest_exponent: float,
    ) -> None:
        normal, score = data.eliminated
        self.phases = np.array(start, dtype=float)
        self._rows = np.arange(len(self.phases))
        count = len(self._rows)
        hyperprior = USUAL.hyperprior
        self.constants = constants or PottsConstants(
            np.full(count, hyperprior.face_nats), element_nats=np.zeros(count)
        )
        self._normal = normal
        self._diagonal = np.diag(normal).copy()
        self._target = normal @ data.base - score
        self._neighbours = faces.build_adjacency().toarray()
        self._degrees = self._neighbours.sum(axis=1)
        self._limit = largest_exponent
        # Sums over the elements of phase 1 in each chain.
        self._normal_sums = self.phases @ normal
        precision = 1 / data.deviation**2
        self._information = precision + (self.phases * self._normal_sums).sum(axis=1)
        self._moments = data.mean * precision + self.phases @ self._target
        self._neighbour_sums = self.phases @ self._neighbours
        self._energies = self._flip_energies()

    def draw_constants(self, hyperprior: PottsHyperprior, rng: np.random.Generator) -> None:
        """Replace the constants of the Potts prior by draws given the phases, in place."""
        self.constants = hyperprior.draw(
            self.phases, 2 * self._neighbour_sums - self._degrees, self.constants, rng=rng
        )
        self._energies = self._flip_energies()

    def estimate_mean_contrasts(self) -> Array:
        """Return the mean (C,) of s given the phases."""
        return self._moments / self._information

    def draw_contrasts(self, rng: np.random.Generator) -> Array:
        """Draw s (C,) given the phases."""
        noise = rng.normal(size=len(self._rows)) / np.sqrt(self._information)
        return self.estimate_mean_contrasts() + noise

    def propose(self, rng: np.random.Generator) -> float:
        """Propose a flip in each chain; return the share of accepted ones."""
        forward = np.cumsum(self._weights(self._energies), axis=1)
        drawn = rng.random((len(forward), 1)) * forward[:, -1:]
        chosen = np.minimum((forward < drawn).sum(axis=1), forward.shape[1] - 1)
        everywhere = np.ones(len(chosen), dtype=bool)
        self._flip(chosen, everywhere)
        energies = self._flip_energies()
        back = self._weights(energies).sum(axis=1)
        accepted = rng.random(len(back)) * back < forward[:, -1]
        self._flip(chosen, ~accepted)
        self._energies = np.where(accepted[:, None], energies, self._energies)
        return float(accepted.mean())

    def _weights(self, energies: Array) -> Array:
        """Return the weights of the proposals from the energies of the flips (C, E)."""
        return np.exp(np.clip(-energies / 2, -self._limit, self._limit))

    def _flip_energies(self) -> Array:
        """Return −ln of the ratio of posteriors with each phase flipped (C, E)."""
        signs = 1 - 2 * self.phases
        before = self._information[:, None]
        information = before + 2 * signs * self._normal_sums + self._diagonal
        moments = self._moments[:, None] + signs * self._target
        of_data = np.log(information / before) - moments**2 / information
        of_data += self._moments[:, None] ** 2 / before
        of_prior = (
            self.constants.face_nats[:, None] * (self._degrees - 2 * self._neighbour_sums)
            - self.constants.element_nats[:, None]
        )
        return of_data / 2 + signs * of_prior

    def _flip(self, elements: Index, mask: NDArray[np.bool_]) -> None:
        """Flip one element (C,) in each chain of a mask (C,), in place."""
        rows = self._rows[mask]
        flipped = elements[mask]
        signs = 1 - 2 * self.phases[rows, flipped]
        self._information[rows] += (
            2 * signs * self._normal_sums[rows, flipped] + self._diagonal[flipped]
        )
        self._moments[rows] += signs * self._target[flipped]
        self._normal_sums[rows] += signs[:, None] * self._normal[flipped]
        self._neighbour_sums[rows] += signs[:, None] * self._neighbours[flipped]
        self.phases[rows, flipped] += signs
