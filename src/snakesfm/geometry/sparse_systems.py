"""Large sparse systems without a factor, whose size grows faster than the number of cameras."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


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
