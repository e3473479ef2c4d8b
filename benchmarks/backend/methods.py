"""What is compared: snakesfm's filters and averagers, pycolmap's, and the best possible."""

from collections.abc import Callable

import numpy as np

from benchmarks.backend.problems import Problem
from snakesfm.arrays import Array
from snakesfm.config.filter_view_graph import FilterViewGraphOptions
from snakesfm.rotation_averaging.base import RotationGraph
from snakesfm.rotation_averaging.linear import apply_increments, solve_anisotropic, world_residuals
from snakesfm.rotation_averaging.noise import fill_covariances
from snakesfm.rotation_averaging.registry import make_averager
from snakesfm.rotation_averaging.verification import average_view_graph
from snakesfm.stages.filter_view_graph import refuse_edges
from snakesfm.view_graph.cycles import find_cycles
from snakesfm.view_graph.filters import keep_largest_component

FILTERS = {
    "messages": FilterViewGraphOptions(),
    "cycles": FilterViewGraphOptions(method="cycles", cluster_vote=False),
}


def snakesfm_rotations(problem: Problem, filtering: str, averaging: str) -> Array:
    """What filter_view_graph (or ``none``) and average_rotations do with their defaults."""
    node_count, pairs = len(problem.truth), problem.pairs
    reasons = np.full(len(pairs), "kept", dtype=object)
    if filtering != "none":
        cycles = find_cycles(node_count, pairs, problem.rotations)
        reasons = refuse_edges(
            node_count, pairs, problem.rotations, problem.counts, cycles, FILTERS[filtering]
        )
    reasons, _ = keep_largest_component(node_count, pairs, reasons)
    graph = RotationGraph(
        node_count,
        pairs,
        problem.rotations,
        np.maximum(problem.counts, 1e-6),
        problem.covariances[:, :3, :3],
    )
    return average_view_graph(make_averager(averaging), graph, reasons, 5.0, 10.0)[0]


def colmap_rotations(problem: Problem, reweighting: str) -> Array:
    """Rotation averaging of pycolmap with its default options but for ``reweighting``."""
    from snakesfm.geometry.colmap_binding import pycolmap

    pycolmap.logging.minloglevel = 3
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=2, height=2, params=[1, 1, 1, 1])
    )
    for image in range(len(problem.truth)):
        model.add_image_with_trivial_frame(pycolmap.Image(name=str(image), camera_id=1, image_id=image + 1))
    graph = pycolmap.PoseGraph()
    for (i, j), rotation, translation, count in zip(
        problem.pairs.tolist(), problem.rotations, problem.translations, problem.counts, strict=True
    ):
        edge = pycolmap.PoseGraphEdge(pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
        edge.num_matches = int(count)
        graph.add_edge(i + 1, j + 1, edge)
    options = pycolmap.RotationEstimatorOptions()
    options.random_seed = problem.seed
    options.reweighting = getattr(pycolmap.RotationAveragingReweighting, reweighting)
    averaged = np.full((len(problem.truth), 3, 3), np.nan)
    if pycolmap.run_rotation_averaging(options, graph, model, []):
        for number, image in model.images.items():
            if image.has_pose:
                averaged[number - 1] = image.cam_from_world().rotation.matrix()
    return averaged


def oracle_rotations(problem: Problem) -> Array:
    """Weighted least squares from the truth on the edges that are not wrong: hardly to be beaten."""
    right = ~problem.wrong
    covariances = fill_covariances(problem.covariances[:, :3, :3], np.maximum(problem.counts, 1.0))
    information = np.linalg.inv(covariances)
    information[~right] = 1e-6 * np.median(information[right, 0, 0]) * np.eye(3)
    known = np.isfinite(problem.truth[:, 0, 0])
    averaged = np.where(known[:, None, None], problem.truth, np.eye(3))
    for _ in range(3):
        tails = averaged[problem.pairs[:, 1]]
        residuals = world_residuals(problem.pairs, problem.rotations, averaged)
        turned = tails.transpose(0, 2, 1) @ information @ tails
        averaged = apply_increments(
            averaged, solve_anisotropic(len(known), problem.pairs, turned, residuals)
        )
    averaged[~known] = np.nan
    return averaged


METHODS: dict[str, Callable[[Problem], Array]] = {
    "colmap": lambda problem: colmap_rotations(problem, "UNIFORM"),
    "colmap by inliers": lambda problem: colmap_rotations(problem, "INLIER_MATCH_COUNT"),
    "messages + two_stage": lambda problem: snakesfm_rotations(problem, "messages", "two_stage"),
    "none + two_stage": lambda problem: snakesfm_rotations(problem, "none", "two_stage"),
    "messages + irls": lambda problem: snakesfm_rotations(problem, "messages", "irls"),
    "cycles + shonan": lambda problem: snakesfm_rotations(problem, "cycles", "shonan"),
    "oracle": oracle_rotations,
}
"""snakesfm's default is ``messages + two_stage``, the paper's system ``cycles + shonan``."""
