"""Synthetic view graphs with wrong edges."""

import itertools

import numpy as np
from scipy.spatial.transform import Rotation


def noisy_graph(node_count, density, seed, noise_deg=0.5, wrong_share=0.0):
    """A random graph: pairs, rotations, which edges are wrong."""
    rng = np.random.default_rng(seed)
    pairs = np.array(list(itertools.combinations(range(node_count), 2)))
    pairs = pairs[rng.uniform(size=len(pairs)) < density]
    truth = Rotation.random(node_count, rng).as_matrix()
    noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(len(pairs), 3))).as_matrix()
    rotations = noise @ truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    wrong = rng.uniform(size=len(pairs)) < wrong_share
    rotations[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    return pairs, rotations, wrong
