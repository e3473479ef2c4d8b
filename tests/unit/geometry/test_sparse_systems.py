import numpy as np
from scipy.sparse import diags_array, eye_array, kron, random_array

from snakesfm.geometry.sparse_systems import conjugate_gradients, solve_spd
from snakesfm.rotation_averaging.linear import solve_isotropic


def test_conjugate_gradients_solve_as_the_factor_does():
    rng = np.random.default_rng(0)
    links = random_array((60, 60), density=0.1, rng=rng)
    blocks = kron(links @ links.T, rng.uniform(0.5, 1.0, 3) * np.eye(3)) + 0.1 * eye_array(180)
    right = rng.normal(size=(180, 2))
    factored = solve_spd(blocks.tocsc(), right, 3)
    iterated = solve_spd(blocks.tocsc(), right, 3, factored_up_to=179, tolerance=1e-4)
    np.testing.assert_allclose(blocks @ factored, right, atol=1e-9)
    assert 1e-12 < np.abs(iterated - factored).max() < 1e-2 * np.abs(factored).max()


def test_where_conjugate_gradients_do_not_converge_the_factor_solves():
    # an iteration passes on what is known by one link, and both ends of this chain must hear of each other
    count = 4000
    chain = diags_array([2.0, -1.0, -1.0], offsets=[0, 1, -1], shape=(count, count)).tocsc()
    right = np.zeros((count, 1))
    right[[0, -1], 0] = 1.0, -3.0
    assert conjugate_gradients(chain, right) is None
    place = np.arange(1, count + 1)[:, None] / (count + 1)
    np.testing.assert_allclose(solve_spd(chain, right, factored_up_to=0), 1.0 - 4.0 * place, atol=1e-8)


def test_rotations_of_a_dense_graph_on_a_long_chain_are_solved_for_exactly():
    # a clique lifts the mean degree above that of graphs that are factored; a chain of 6000 hangs on it
    clique, count = 650, 6650
    pairs = np.column_stack(np.triu_indices(clique, 1))
    chain = np.arange(clique - 1, count - 1)
    pairs = np.concatenate([pairs, np.column_stack([chain, chain + 1])])
    assert 2 * len(pairs) / count > 60
    rng = np.random.default_rng(3)
    truth = np.maximum(np.arange(count) - clique, 0)[:, None] * np.array([1e-3, -2e-3, 3e-3])
    residuals = truth[pairs[:, 1]] - truth[pairs[:, 0]]
    solved = solve_isotropic(count, pairs, rng.uniform(0.5, 2.0, len(pairs)), residuals)
    np.testing.assert_allclose(solved, truth, atol=1e-8)
