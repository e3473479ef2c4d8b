"""Shonan averaging by gtsam: globally optimal where its certificate holds."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationAverager, RotationGraph
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.rotation_averaging.tree import tree_rotations


@dataclass(frozen=True)
class ShonanAverager(RotationAverager):
    """Shonan averaging with optimality certificate, as in GTSfM; least squares, so blind to outliers.

    Where it does not converge (it does not on large graphs with outliers), Huber's loss without certificate
    is used instead, from the same start.

    Parameters
    ----------
    sigma_rad : standard deviation of every edge; the paper's constant.
    p_min, p_max : dimensions of the rotation manifolds to climb through; where 8 do not suffice, the 30 of
        the paper take minutes and still fail.

    References
    ----------
    Dellaert et al., Shonan Rotation Averaging, ECCV 2020.
    """

    sigma_rad: float = 1.0
    p_min: int = 3
    p_max: int = 8

    def solve(self, graph: RotationGraph) -> Array:
        """Rotations (N,3,3) of a connected graph."""
        import gtsam

        start = IrlsAverager().straighten(
            graph, tree_rotations(graph.node_count, graph.pairs, graph.rotations, 1.0 / graph.weights)
        )
        values = gtsam.Values()
        for node, rotation in enumerate(start):
            values.insert(node, gtsam.Rot3(rotation.T))
        try:
            solved = self._run(graph, values, robust=False)
        except RuntimeError:
            solved = self._run(graph, values, robust=True)
        return np.stack([solved.atRot3(node).matrix().T for node in range(graph.node_count)])

    def _run(self, graph: RotationGraph, values: Any, robust: bool) -> Any:
        import gtsam

        noise = gtsam.noiseModel.Isotropic.Sigma(3, self.sigma_rad)
        measurements = gtsam.BinaryMeasurementsRot3()
        for (i, j), rotation in zip(graph.pairs, graph.rotations, strict=True):
            # gtsam's rotations are world_from_camera, its measurements i_from_j
            measurements.append(gtsam.BinaryMeasurementRot3(int(i), int(j), gtsam.Rot3(rotation.T), noise))
        parameters = gtsam.ShonanAveragingParameters3(gtsam.LevenbergMarquardtParams.CeresDefaults())
        parameters.setUseHuber(robust)
        parameters.setCertifyOptimality(not robust)
        problem = gtsam.ShonanAveraging3(measurements, parameters)
        p_min = self.p_min if not robust else max(self.p_min, 5)
        return problem.run(values, p_min, p_min if robust else self.p_max)[0]
