"""Sparse systems, large ones without a factor, whose size grows faster than the number of cameras."""

from typing import Any

import numpy as np

from snakesfm.arrays import Array

FACTORED_UNKNOWNS = 5000
"""Unknowns up to which a graph's factor costs less than a second; its cost grows faster than the graph."""


def solve_spd(
    matrix: Any,
    right: Array,
    block: int = 1,
    factored_up_to: int = FACTORED_UNKNOWNS,
    tolerance: float = 1e-8,
    iterations: int = 1500,
) -> Array:
    """Solution (n,k) of a sparse symmetric positive definite system.

    By conjugate gradients for more than ``factored_up_to`` unknowns; by a sparse factor for fewer, or where
    these do not converge. The others are the parameters of :func:`conjugate_gradients`.
    """
    from scipy.sparse.linalg import splu

    if matrix.shape[0] > factored_up_to:
        iterated = conjugate_gradients(matrix, right, block, tolerance, iterations)
        if iterated is not None:
            return iterated
    factor = splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return np.asarray(factor.solve(right))


def conjugate_gradients(
    matrix: Any, right: Array, block: int = 1, tolerance: float = 1e-8, iterations: int = 1500
) -> Array | None:
    """Solution (n,k) of a sparse symmetric positive definite system; None where it does not converge.

    Conjugate gradients with the inverse diagonal blocks as preconditioner (Golub and Van Loan, Matrix
    Computations, 11.5), whose memory and time per iteration are those of the matrix. Long chains converge
    slowly, but their factor is small.

    Parameters
    ----------
    matrix : (n,n) sparse, n a multiple of ``block``.
    right : (n,k).
    block : rows of a diagonal block.
    tolerance : largest residual, relative to ``right``.
    iterations : after which it is given up.
    """
    from scipy.sparse import bsr_matrix
    from scipy.sparse.linalg import cg

    blocks = matrix.tobsr((block, block))
    count = matrix.shape[0] // block
    block_row = np.repeat(np.arange(count), np.diff(blocks.indptr))
    inverse = np.linalg.inv(blocks.data[blocks.indices == block_row])
    places = np.arange(count + 1)
    preconditioner = bsr_matrix((inverse, places[:-1], places), shape=matrix.shape)
    # a matrix of single numbers is multiplied faster by rows
    system = blocks if block > 1 else matrix.tocsr()
    columns = []
    for column in right.T:
        solution, failed = cg(system, column, rtol=tolerance, maxiter=iterations, M=preconditioner)
        if failed:
            return None
        columns.append(solution)
    return np.stack(columns, axis=1)
