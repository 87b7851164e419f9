"""Choice of MUMPS's ordering by its own analysis of the pattern of the KKT matrix.

Which of two orderings needs fewer operations depends on body and recording: quasi-dense minimum
degree (QAMD) 0.7 times those of nested dissection (METIS) for the foam cylinder, 1.4 times for
Table I. MUMPS states the number only in its output, hence the isolated process. Slender bodies have
minimum degree (AMD).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ..common.isolated_process import Failed, run_isolated
from ..program.collocation import Collocation

AMD, METIS, QAMD = 0, 5, 6
# Size of the KKT matrix below which METIS is taken: a factorisation then takes less than a second,
# and the choice half a second.
LEAST_ROWS = 20_000

_ANALYSE = """
import os, re
os.environ["GFORTRAN_UNBUFFERED_PRECONNECTED"] = "y"
os.dup2(os.open("printed.txt", os.O_RDWR | os.O_CREAT), 1)
import casadi as ca
indptr, indices = given["indptr"], given["indices"]
size = len(indptr) - 1
values = numpy.zeros(len(indices))
values[indptr[1:] - 1] = 1.0
matrix = ca.DM(ca.Sparsity(size, size, indptr.tolist(), indices.tolist()), values.tolist())
x, p, w = ca.MX.sym("x", size), ca.MX.sym("p", 0), ca.MX.sym("w")
hessian = ca.Function("hessian", [x, p, w, ca.MX.sym("y", 0)], [ca.MX(matrix)])
for ordering in given["orderings"].tolist():
    options = {"mumps_pivot_order": ordering, "mumps_print_level": 2, "linear_solver": "mumps",
        "mumps_scaling": 0, "print_level": 0, "sb": "yes", "option_file_name": "", "max_iter": 1}
    options = {"hess_lag": hessian, "print_time": False, "ipopt": options}
    ca.nlpsol("solver", "ipopt", {"x": x, "f": ca.sumsqr(x) / 2}, options)(x0=1)
with open("printed.txt") as printed:
    operations = re.findall(r"RINFOG\\(1\\).*= *(\\S+)", printed.read())
found = {"operations": [float(each.replace("D", "E")) for each in operations]}
"""


def cheaper_ordering(program: Collocation, with_hessian: bool = True) -> int:
    """Return MUMPS's number of the ordering with which the KKT matrix takes fewer operations; that
    of METIS if the matrix is small or the numbers are not found.

    Parameters
    ----------
    program : Collocation
        The program that IPOPT solves.
    with_hessian : bool
        Whether the matrix contains the Hessian; otherwise a diagonal in its place.
    """
    if program.variable_count + program.constraint_count < LEAST_ROWS:
        return METIS
    pattern = sp.csc_array(_one_of_each(_kkt_pattern(program, with_hessian)))
    pattern.sort_indices()
    arrays = {"indptr": pattern.indptr, "indices": pattern.indices}
    try:
        found = run_isolated(_ANALYSE, orderings=[METIS, QAMD], **arrays)
        of_metis, of_qamd = found["operations"]
    except (Failed, ValueError):
        return METIS
    return QAMD if of_qamd < of_metis else METIS


def _kkt_pattern(program: Collocation, with_hessian: bool) -> sp.csr_array:
    """Pattern of the upper triangle of the KKT matrix, with its diagonal; IPOPT removes variables
    with equal bounds.
    """
    lower, upper = program.bounds()
    free = np.flatnonzero(lower < upper)
    size, rows = program.variable_count, program.constraint_count

    def pattern(structure: tuple[np.ndarray, np.ndarray], count: int) -> sp.csc_array:
        indptr, indices = structure
        ones = np.ones(len(indices), dtype=np.uint64)
        return sp.csc_array((ones, indices, indptr), shape=(count, size))[:, free]

    jacobian = pattern(program.jacobian_structure, rows)
    hessian = sp.csc_array((len(free), len(free)))
    if with_hessian:
        hessian = sp.csc_array(sp.triu(pattern(program.hessian_structure, size)[free], 1))
    matrix = sp.block_array([[hessian, jacobian.T], [None, sp.csc_array((rows, rows))]])
    return sp.csr_array(matrix + sp.eye_array(len(free) + rows), dtype=np.uint64)


def _one_of_each(pattern: sp.csr_array) -> sp.csr_array:
    """Return the pattern of one row and column of each group with the same neighbours: the three
    positions of a node, and its three equations of motion, which are not neighbours of each other.

    The number of operations is nearly divided by 27, for each ordering alike.
    """
    random = np.random.default_rng(0)
    for own in (0, 1):
        keys = random.integers(2**63, size=pattern.indptr.size - 1, dtype=np.uint64)
        sums = pattern @ keys + pattern.T @ keys - np.uint64(1 + own) * keys
        first = np.sort(np.unique(sums, return_index=True)[1])
        pattern = sp.csr_array(pattern[first][:, first])
    return pattern
