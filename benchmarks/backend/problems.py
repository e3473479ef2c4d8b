"""View graphs with known truth: synthetic ones of several sources, and real ones."""

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from snakesfm.arrays import Array
from snakesfm.synthetic.problems import Layout, make_problem

LAYOUTS: tuple[Layout, ...] = ("ring", "street", "area", "facade")

FAMILIES = ("orbit", "dome", "corridor", "lawnmower", "crowd", "walk", "manhattan")

SYMMETRIC_CASES: dict[str, dict[str, Any]] = {
    "orbit": {"scene": "object", "scene_params": {"symmetry_fold": 4}},
    "dome": {"scene": "object", "scene_params": {"symmetry_fold": 2}},
    "corridor": {"scene": "corridor", "scene_params": {"periodic": True}},
    "crowd": {"scene": "plaza", "scene_params": {"monument_fold": 4}},
    "manhattan": {"scene": "urban", "scene_params": {"twin_buildings": 4}},
}
"""Scenes of ViewGraphForge that repeat themselves: their wrong edges agree with each other."""


@dataclass(frozen=True)
class Problem:
    """A view graph of N cameras, its truth, and what the cameras see.

    Parameters
    ----------
    name, source : of the problem, and of what made it.
    cameras : how many were asked for.
    outliers : share of edges that were replaced by random ones.
    coherent : wrong edges by repeated structure are among the others.
    seed : of the problem.
    pairs : (E,2) int64, i < j, sorted.
    rotations : (E,3,3) j_from_i.
    translations : (E,3) unit, of j_from_i.
    counts : (E,) inlier matches.
    covariances : (E,5,5) rad^2, of the rotation's left increment and of direction's tangents; NaN: unknown.
    wrong : (E,) bool, edges that are no measurement of the true pose.
    truth : (N,3,3) cam_from_world, NaN where unknown.
    centers : (N,3).
    ray_images, ray_tracks : (Q,) int64, by track, then image.
    rays : (Q,2) points seen, undistorted, on the plane z = 1.
    """

    name: str
    source: str
    cameras: int
    outliers: float
    coherent: bool
    seed: int
    pairs: Array
    rotations: Array
    translations: Array
    counts: Array
    covariances: Array
    wrong: Array
    truth: Array
    centers: Array
    ray_images: Array
    ray_tracks: Array
    rays: Array

    def save(self, path: Path) -> None:
        """Write to an .npz file."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)})

    @staticmethod
    def load(path: Path) -> "Problem":
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            values = {name: value if value.ndim else value.item() for name, value in file.items()}
        return Problem(**values)


def forge(
    family: str, cameras: int, outliers: float, coherent: bool, seed: int, noise: str = "analytic"
) -> Problem:
    """A graph of ViewGraphForge; its random outliers do not depend on the inlier count."""
    import viewgraphforge

    parameters: dict[str, Any] = {
        "family": family,
        "n_nodes": cameras,
        "outlier_ratio": outliers,
        "outlier_mode": "both",
        "outlier_weighting": "uniform",
        "noise_model": noise,
        "store_observations_max_nodes": cameras,
        "max_observations_per_camera": 100,
    }
    if coherent:
        parameters |= copy.deepcopy(SYMMETRIC_CASES[family]) | {"symmetry_confusability": 0.35}
    graph = viewgraphforge.generate_graph(parameters, seed=seed)
    arrays = graph.arrays
    order = np.lexsort((arrays["edge_j"], arrays["edge_i"]))
    kinds = arrays["edge_outlier_type"][order]
    sigmas = np.stack([arrays["edge_sigma_rot"], arrays["edge_sigma_dir"]], axis=1)[order] ** 2
    rays = _sorted_rays(
        arrays["obs_cam"].astype(np.int64),
        _mixed_up(arrays["obs_point"].astype(np.int64), outliers / 2, seed),
        arrays["obs_xy"],
    )
    return Problem(
        name=f"{family}{'-twoview' if noise == 'twoview' else ''}",
        source="viewgraphforge",
        cameras=cameras,
        outliers=outliers,
        coherent=coherent,
        seed=seed,
        pairs=graph.edges[order].astype(np.int64),
        rotations=graph.R_meas[order],
        translations=graph.tdir_meas[order],
        counts=arrays["edge_n_matches"][order].astype(np.float64),
        covariances=np.eye(5) * sigmas[:, [0, 0, 0, 1, 1], None],
        wrong=(kinds > 0) & (kinds < 5),
        truth=graph.R_wc,
        centers=graph.centers,
        ray_images=rays[0],
        ray_tracks=rays[1],
        rays=rays[2].astype(np.float64),
    )


def synthesize(cameras: int, outliers: float, seed: int) -> Problem:
    """A full problem of pycolmap, whose relative poses and covariances snakesfm's own estimator finds.

    The noise of an image's keypoints is the same in all its pairs, as in real images; a tenth of the
    matches of every pair is wrong. Each camera is paired with about 20 others.
    """
    from snakesfm.config.estimate_two_view import EstimateTwoViewOptions
    from snakesfm.geometry.camera import Camera
    from snakesfm.geometry.colmap_binding import pycolmap
    from snakesfm.two_view.estimate import estimate_two_view_geometry

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, cameras
    options.num_points3D, options.track_length = 60 * cameras, 12
    pycolmap.set_random_seed(seed)
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(seed)
    parameters = model.cameras[1].params
    camera = Camera(
        model.cameras[1].model.name, model.cameras[1].width, model.cameras[1].height, tuple(parameters)
    )
    truth, centers, keypoints, seen = [], [], [], []
    for number in sorted(model.images):
        image = model.images[number]
        pose = image.cam_from_world()
        truth.append(pose.rotation.matrix())
        centers.append(image.projection_center())
        observed = [point for point in image.points2D if point.has_point3D()]
        pixels = np.array([point.xy for point in observed])
        keypoints.append((pixels + rng.normal(0, 1.0, pixels.shape)).astype(np.float32))
        seen.append(np.array([point.point3D_id for point in observed]))
    rows = []
    pairs = np.stack(np.triu_indices(cameras, 1), axis=1)
    pairs = pairs[rng.uniform(size=len(pairs)) < 20.0 / (cameras - 1)]
    settings = EstimateTwoViewOptions()
    for i, j in pairs:
        _, in_i, in_j = np.intersect1d(seen[i], seen[j], return_indices=True)
        mixed = rng.uniform(size=len(in_j)) < 0.1
        in_j[mixed] = rng.permutation(in_j[mixed])
        matches = np.stack([in_i, in_j], axis=1).astype(np.int32)
        found = estimate_two_view_geometry(
            keypoints[i], keypoints[j], matches, camera, camera, settings, seed
        )
        rows.append(found)
    good = np.array([not row.rejection for row in rows], dtype=bool)
    pairs = pairs[good].astype(np.int64)
    chosen = [row for row in rows if not row.rejection]
    rotations = np.stack([row.rotation for row in chosen])
    translations = np.stack([row.translation for row in chosen])
    wrong = rng.uniform(size=len(pairs)) < outliers
    rotations[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    translations[wrong] = _directions(int(wrong.sum()), rng)
    images = np.repeat(np.arange(cameras), [len(ids) for ids in seen])
    tracks = np.unique(np.concatenate(seen), return_inverse=True)[1]
    rays = np.concatenate([camera.normalize(points) for points in keypoints])
    images, tracks, rays = _sorted_rays(images, _mixed_up(tracks, outliers / 2, seed), rays)
    return Problem(
        name="synthesize_dataset",
        source="pycolmap",
        cameras=cameras,
        outliers=outliers,
        coherent=False,
        seed=seed,
        pairs=pairs,
        rotations=rotations,
        translations=translations,
        counts=np.array([float(len(row.inliers)) for row in chosen]),
        covariances=np.stack([row.covariance for row in chosen]),
        wrong=wrong,
        truth=np.stack(truth),
        centers=np.stack(centers),
        ray_images=images,
        ray_tracks=tracks,
        rays=rays,
    )


def lay_out(layout: Layout, cameras: int, outliers: float, seed: int) -> Problem:
    """A problem of snakesfm.synthetic: narrow views, occlusion, 40 points a camera, half a pixel of noise.

    Rotations of edges are off by 0.3 degrees, directions by 0.6, as their covariances say. Beside the wrong
    edges, rays of half as large a share see something else than the others of their track.
    """
    made = make_problem(
        cameras,
        40 * cameras,
        layout,
        outlier_ratio=outliers / 2,
        pair_outlier_ratio=outliers,
        seed=seed,
    )
    return Problem(
        name=layout,
        source="snakesfm",
        cameras=cameras,
        outliers=outliers,
        coherent=False,
        seed=seed,
        pairs=made.pairs.astype(np.int64),
        rotations=made.edge_rotations,
        translations=made.edge_translations,
        counts=np.maximum(made.edge_inlier_counts, 1).astype(np.float64),
        covariances=made.edge_covariances,
        wrong=made.edge_outliers,
        truth=made.rotations,
        centers=made.centers,
        ray_images=made.track_image_ids.astype(np.int64),
        ray_tracks=np.repeat(np.arange(len(made.points)), np.diff(made.track_offsets)),
        rays=made.cameras[0].normalize(made.track_keypoints),
    )


def read_real(folder: Path, name: str) -> Problem:
    """A view graph of real photographs with reference poses; it knows no covariances and sees no points."""
    edges = np.loadtxt(folder / f"{name}.EGs.txt")
    edges = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    reference = np.loadtxt(folder / f"{name}.gt.txt", usecols=(0, *range(2, 9)))
    count = int(max(edges[:, 1].max(), reference[:, 0].max())) + 1
    known = reference[:, 0].astype(np.int64)
    truth, centers = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    truth[known] = Rotation.from_quat(reference[:, [2, 3, 4, 1]]).as_matrix()
    centers[known] = reference[:, 5:8]
    pairs = edges[:, :2].astype(np.int64)
    left, _, right = np.linalg.svd(edges[:, 3:12].reshape(-1, 3, 3))
    rotations = left @ right
    exact = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    cosines = 0.5 * (np.einsum("eab,eab->e", rotations, exact) - 1.0)
    wrong = ~(np.arccos(np.clip(cosines, -1.0, 1.0)) <= np.radians(5.0))
    return Problem(
        name=name,
        source="real",
        cameras=len(truth),
        outliers=float(np.round(wrong.mean(), 2)),
        coherent=True,
        seed=0,
        pairs=pairs,
        rotations=rotations,
        translations=edges[:, 12:15],
        counts=edges[:, 2],
        covariances=np.full((len(pairs), 5, 5), np.nan),
        wrong=wrong,
        truth=truth,
        centers=centers,
        ray_images=np.zeros(0, dtype=np.int64),
        ray_tracks=np.zeros(0, dtype=np.int64),
        rays=np.zeros((0, 2)),
    )


def _sorted_rays(images: Array, tracks: Array, rays: Array) -> tuple[Array, Array, Array]:
    order = np.lexsort((images, tracks))
    return images[order], tracks[order], rays[order]


def _mixed_up(tracks: Array, share: float, seed: int) -> Array:
    """Tracks of rays, of which a share was swapped among each other."""
    rng = np.random.default_rng(seed)
    mixed = rng.uniform(size=len(tracks)) < share
    tracks = tracks.copy()
    tracks[mixed] = rng.permutation(tracks[mixed])
    return tracks


def _directions(count: int, rng: np.random.Generator) -> Array:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
