"""Two-phase fields: posterior of which elements belong to an inclusion, by linearised measurements.

With the residuals linear in parameters p and in the logarithm z_e of a constant in every element,
and z_e = s h_e for phases h ∈ {0, 1}ᴱ and the logarithm s of the contrast, the posterior is

    −2 ln π(h, s, p) = ‖r + S_p δp + S_z (s h − z₀)‖²/T + s²/A² + priors of p + 2 J Σ_f w_f |Δh|_f.

The last sum is over the faces f between two elements, w_f is the face's area over the mean area and
|Δh|_f is one where the phases differ: the prior of Ising and Potts, a total variation of h. T is
the lack of fit, at least one: by how much χ² exceeds that of the smooth field, per mode that the
smooth field determines. It is one if two phases describe the body and the right ones are found;
otherwise, and where the linearisation is inaccurate, it widens intervals.

Phases start at a total-variation estimate of z, divided into two classes (Otsu 1979), and are drawn
one element at a time by locally balanced proposals (Zanella 2020); given h, s and δp are normal and
drawn together. A modal level set, ln c = s H(φ) with a smooth step H and a normal φ, was tried: its
posterior mode has H near one half everywhere and several times the contrast (10 for 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..common.array_types import Array, Index
from ..fem.meshes.mesh import TetMesh


@dataclass(frozen=True)
class SamplerSettings:
    """Constants of the sampler.

    Attributes
    ----------
    face_nats : float
        Strength J of the prior. On twins with an inclusion of factor 3 of some 80 elements, 2 and 3
        gave the same contrast; with 1 single elements flickered and the contrast was 6 % lower.
    steps_per_element : int
        Proposals per element and chain; the first quarter is discarded.
    least_steps : int
        Fewest proposals of a chain.
    chains : int
        Chains with independent random numbers. Their samples count equally, so that an interval
        contains the optima that chains end in.
    steps_per_draw : int
        Proposals between draws of s and δp.
    steps_per_sample : int
        Proposals between stored samples.
    total_variation : float
        Weight of the total variation of z per face at the start, in units of −2 ln π.
    smallest_jump : float
        Differences of z across a face that the start does not sharpen.
    sharpenings : int
        Reweighted least-squares solves of the start.
    largest_exponent : float
        Limit of the exponents of the proposals' weights, against overflow.
    """

    face_nats: float = 2.5
    steps_per_element: int = 10
    least_steps: int = 4000
    chains: int = 3
    steps_per_draw: int = 10
    steps_per_sample: int = 20
    total_variation: float = 1.0
    smallest_jump: float = 0.02
    sharpenings: int = 8
    largest_exponent: float = 30.0


USUAL = SamplerSettings()


@dataclass(frozen=True, eq=False)
class InternalFaces:
    """Faces between two elements.

    Attributes
    ----------
    pairs : (F, 2) array
        Indices of the elements on both sides.
    weights : (F,) array
        Area over the mean area.
    element_count : int
        Number E of elements.
    """

    pairs: Index
    weights: Array
    element_count: int

    @classmethod
    def from_mesh(cls, mesh: TetMesh, cells: Index) -> InternalFaces:
        """Find the faces between some elements of a mesh.

        Parameters
        ----------
        mesh : TetMesh
        cells : (E,) array
            Indices of the elements; `pairs` has indices into this array. Faces to other elements
            are left out.
        """
        corners = mesh.tetrahedra[cells]
        triples = np.sort(
            corners[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2
        )
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

    @property
    def adjacency(self) -> sp.csr_array:
        """Symmetric sparse matrix (E, E) of the weights of the faces between elements, zero where
        there is no face.
        """
        i, j = self.pairs.T
        both = (np.r_[self.weights, self.weights], (np.r_[i, j], np.r_[j, i]))
        return sp.csr_array(
            both, shape=(self.element_count, self.element_count)
        )

    @property
    def jump_operator(self) -> sp.csr_array:
        """Sparse matrix (F, E) from values in elements to their jump across each face: the value of
        the first element of the pair less that of the second.
        """
        faces = np.arange(len(self.pairs))
        ends = np.r_[faces, faces], self.pairs.T.ravel()
        signs = np.repeat([1.0, -1.0], len(faces))
        return sp.csr_array(
            (signs, ends), shape=(len(faces), self.element_count)
        )


@dataclass(frozen=True, eq=False)
class ElementInformation:
    """Normal equations of the linearised measurements, by changes of p and of z.

    Attributes
    ----------
    of_p : (p, p) array
        S_pᵀS_p / T and the information of the priors.
    mixed : (E, p) array
        S_zᵀS_p / T.
    of_z : (E, E) array
        S_zᵀS_z / T.
    score_p : (p,) array
        S_pᵀr / T and the score of the priors.
    score_z : (E,) array
        S_zᵀr / T.
    base : (E,) array
        Expansion point z₀.
    deviation : float
        Prior standard deviation A of s.
    """

    of_p: Array
    mixed: Array
    of_z: Array
    score_p: Array
    score_z: Array
    base: Array
    deviation: float


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Samples of one or several chains.

    Attributes
    ----------
    phases : (K, E) array
        Phases, 0 or 1.
    contrasts : (K,) array
        Logarithms s of the contrast.
    changes : (K, p) array
        Changes δp of the parameters.
    means : (K, p + 1) array
        Means of δp and s given the phases.
    probability : (E,) array
        Probability of phase 1 in each element.
    accepted : float
        Share of accepted proposals.
    """

    phases: NDArray[np.int8]
    contrasts: Array
    changes: Array
    means: Array
    probability: Array
    accepted: float


def initial_phases(
    data: ElementInformation,
    faces: InternalFaces,
    volumes_m3: Array,
    settings: SamplerSettings = USUAL,
) -> Array:
    """Return initial phases (E,) of 0 and 1 from the total-variation estimate of z, divided into
    two classes.

    The class of smaller volume is the inclusion, phase 1.

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

    Notes
    -----
    The total variation is minimised by `SamplerSettings.sharpenings` reweighted least-squares
    solves, with p eliminated.
    """
    inverse = np.linalg.pinv(data.of_p, hermitian=True)
    normal = data.of_z - data.mixed @ inverse @ data.mixed.T
    score = data.score_z - data.mixed @ (inverse @ data.score_p)
    jumps = faces.jump_operator
    z = data.base
    for _ in range(settings.sharpenings):
        smoothed = np.sqrt((jumps @ z) ** 2 + settings.smallest_jump**2)
        weights = settings.total_variation * faces.weights / smoothed
        prior = (jumps.T @ sp.diags_array(weights) @ jumps).toarray()
        # No measurement tells the mean of z, which p has too.
        prior[np.diag_indices_from(prior)] += (
            1e-9 * np.trace(prior) / len(prior)
        )
        z = np.linalg.solve(normal + prior, normal @ data.base - score)
    above = z >= _class_threshold(z, volumes_m3)
    return (
        above if volumes_m3[above].sum() <= volumes_m3.sum() / 2 else ~above
    ).astype(float)


def _class_threshold(values: Array, weights: Array) -> float:
    """Return the threshold between two classes of values (E,) with the least weighted variance
    within (Otsu).

    Parameters
    ----------
    values : (E,) array
        Values, at least two.
    weights : (E,) array
        Their weights, all positive.

    Returns
    -------
    float
        The least value of the upper class.
    """
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
    settings: SamplerSettings = USUAL,
) -> PosteriorDraws:
    """Draw phases, contrast and parameters from their posterior, by several chains, whose samples
    are concatenated.

    The same arguments give the same samples.

    Parameters
    ----------
    data : ElementInformation
        Normal equations.
    faces : InternalFaces
        Faces between elements.
    start : (E,) array
        Initial phases, 0 or 1.
    settings : SamplerSettings
        Constants of the sampler.
    """
    chains = [
        _run_chain(data, faces, start=start, seed=seed, settings=settings)
        for seed in range(settings.chains)
    ]
    phases = np.concatenate([chain.phases for chain in chains])
    return PosteriorDraws(
        phases=phases,
        contrasts=np.concatenate([chain.contrasts for chain in chains]),
        changes=np.concatenate([chain.changes for chain in chains]),
        means=np.concatenate([chain.means for chain in chains]),
        probability=phases.mean(axis=0),
        accepted=float(np.mean([chain.accepted for chain in chains])),
    )


def _run_chain(
    data: ElementInformation,
    faces: InternalFaces,
    start: Array,
    seed: int,
    settings: SamplerSettings,
) -> PosteriorDraws:
    """Draw phases, contrast and parameters by one chain, whose first quarter is discarded.

    Parameters
    ----------
    data : ElementInformation
        Normal equations.
    faces : InternalFaces
        Faces between elements.
    start : (E,) array
        Initial phases, 0 or 1; not modified.
    seed : int
        Seed of the random numbers.
    settings : SamplerSettings
        Constants of the sampler.

    Notes
    -----
    Phases flip one at a time: element e is proposed with a probability proportional to the root of
    the ratio of posteriors with and without the flip (locally balanced), and accepted by Metropolis
    and Hastings. δp and s are drawn from their normal distribution every `steps_per_draw`
    proposals.
    """
    rng = np.random.default_rng(seed)
    count = len(start)
    steps = max(settings.least_steps, settings.steps_per_element * count)
    limit = settings.largest_exponent
    neighbours = faces.adjacency
    degrees = np.asarray(neighbours.sum(axis=1)).ravel()
    diagonal = np.diag(data.of_z)
    constant = data.score_z - data.of_z @ data.base
    of_p = data.score_p - data.mixed.T @ data.base

    phase = start.copy()
    of_z_phase = data.of_z @ phase
    neighbour_sums = neighbours @ phase

    def conditional() -> tuple[Array, Array]:
        """Return the mean (p + 1,) of (δp, s) given the present phases, and the lower triangular
        factor L of their information L Lᵀ.
        """
        coupling = data.mixed.T @ phase
        own = phase @ of_z_phase + 1 / data.deviation**2
        information = np.block(
            [[data.of_p, coupling[:, None]], [coupling, np.array([[own]])]]
        )
        information[np.diag_indices_from(information)] *= 1 + 1e-12
        factor = np.linalg.cholesky(information)
        right = -np.r_[of_p, phase @ constant]
        half = solve_triangular(factor, right, lower=True)
        mean: Array = solve_triangular(factor.T, half)
        return mean, np.asarray(factor, dtype=float)

    def drawn() -> tuple[Array, Array]:
        """Return the mean and a draw of (δp, s), each (p + 1,), given the present phases."""
        mean, factor = conditional()
        noise = rng.normal(size=len(mean))
        return mean, mean + np.asarray(solve_triangular(factor.T, noise))

    def change(signs: Array) -> Array:
        """Return, for each element, −ln of the ratio of the posteriors with and without its phase
        flipped (E,), at the present δp and s.

        `signs` (E,) are 1 for a phase that becomes 1, and −1 for one that becomes 0.
        """
        force = constant + data.mixed @ both[:-1] + both[-1] * of_z_phase
        own = signs * both[-1] * force + both[-1] ** 2 * diagonal / 2
        return own + settings.face_nats * signs * (degrees - 2 * neighbour_sums)

    mean, both = drawn()
    energy = change(1 - 2 * phase)
    samples: list[tuple[NDArray[np.int8], Array, Array]] = []
    accepted = 0
    for step in range(steps):
        if step % settings.steps_per_draw == 0:
            mean, both = drawn()
            energy = change(1 - 2 * phase)
        weights = np.cumsum(np.exp(np.clip(-energy / 2, -limit, limit)))
        chosen = min(
            int(np.searchsorted(weights, rng.random() * weights[-1])), count - 1
        )
        sign = 1 - 2 * phase[chosen]
        before = of_z_phase, neighbour_sums, energy
        row = slice(neighbours.indptr[chosen], neighbours.indptr[chosen + 1])
        of_z_phase = of_z_phase + sign * data.of_z[chosen]
        neighbour_sums = neighbour_sums.copy()
        neighbour_sums[neighbours.indices[row]] += sign * neighbours.data[row]
        phase[chosen] += sign
        energy = change(1 - 2 * phase)
        back = np.exp(np.clip(-energy / 2, -limit, limit)).sum()
        if rng.random() * back < weights[-1]:
            accepted += 1
        else:
            phase[chosen] -= sign
            of_z_phase, neighbour_sums, energy = before
        if step >= steps // 4 and step % settings.steps_per_sample == 0:
            samples.append((phase.astype(np.int8), both, mean))
    phases = np.array([each[0] for each in samples])
    values = np.array([each[1] for each in samples])
    return PosteriorDraws(
        phases=phases,
        contrasts=values[:, -1],
        changes=values[:, :-1],
        means=np.array([each[2] for each in samples]),
        probability=phases.mean(axis=0),
        accepted=accepted / steps,
    )
