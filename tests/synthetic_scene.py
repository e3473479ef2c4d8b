"""A synthetic problem as the artifacts of a scene."""

from dataclasses import replace

import numpy as np
from plain_artifacts import HEADER, write_plain_cameras, write_plain_index

from snakesfm.artifacts import LocalFeatures, TwoViewGeometries, ViewGraph
from snakesfm.bundle.completion import correspondence_graph
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import BundleModel, from_reconstruction, to_reconstruction
from snakesfm.bundle.round_settings import RoundSettings
from snakesfm.bundle.rounds import adjust_rounds
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.view_graph.components import label_components

STAGES_AFTER = ("rotations", "centers", "tracks", "points", "reconstruction")


def write_scene(made, folder):
    """Write all up to the view graph; the paths of these and of what the stages after it write, by name."""
    count, edges = made.image_count, len(made.pairs)
    names = [f"{i}.jpg" for i in range(count)]
    sizes = [(made.cameras[0].width, made.cameras[0].height)] * count
    blocks = np.arange(count) % 2
    write_plain_index(
        folder / "index.h5", names, sizes, made.cameras, camera_ids=made.camera_ids, blocks=blocks
    )
    write_plain_cameras(folder / "cameras.h5", made.cameras)
    ViewGraph(
        pairs=made.pairs,
        rotations=made.edge_rotations,
        translations=made.edge_translations,
        covariances=made.edge_covariances,
        kinds=np.zeros(edges, int),
        inlier_counts=made.edge_inlier_counts,
        triangulation_angles_deg=made.edge_angles_deg,
        labels=np.zeros(edges, int),
        cycle_min_deg=np.zeros(edges),
        cycle_median_deg=np.zeros(edges),
        components=label_components(count, made.pairs),
    ).write(folder / "graph.h5", HEADER)
    names = ("index", "cameras", "graph", *STAGES_AFTER)
    return {name: folder / f"{name}.h5" for name in names} | {
        "features": write_features(made, folder),
        "geometries": write_geometries(made, folder),
    }


def true_model(made):
    """The truth as the model that bundle adjustment takes."""
    return BundleModel(
        made.cameras,
        made.camera_ids,
        made.rotations,
        made.translations,
        made.points,
        made.track_offsets,
        made.track_image_ids,
        made.track_keypoint_ids,
    )


def graph_of(made, matches=None):
    """The matches, or others of the same pairs, for completion and registration."""
    counts = {row: len(points) for row, points in enumerate(made.keypoints)}
    matches = made.matches if matches is None else matches
    return correspondence_graph(counts, made.pairs, made.match_offsets, matches)


def round_settings(**changes):
    """The options' defaults with changes."""
    names = set(RoundSettings.__dataclass_fields__)
    extra = {"widen_lenses": False, "patient": False, "seed": 0}
    return RoundSettings(**AdjustBundleOptions().model_dump(include=names) | extra | changes)


def run_rounds(made, model, solving=None, **changes):
    """The adjusted model, and the records of its rounds, with changed settings."""
    reconstruction = to_reconstruction(model, made.keypoints, [f"{k}.jpg" for k in range(made.image_count)])
    records = []
    adjust_rounds(
        reconstruction,
        lambda: graph_of(made),
        model.cameras,
        solving or SolverSettings(),
        round_settings(**changes),
        records.append,
    )
    return from_reconstruction(reconstruction, model)[0], records


def side_by_side(first, second):
    """Two problems as one scene of two parts that share the camera and nothing else."""
    images, points = first.image_count, len(first.points)
    return replace(
        first,
        camera_ids=np.r_[first.camera_ids, second.camera_ids],
        rotations=np.concatenate([first.rotations, second.rotations]),
        translations=np.concatenate([first.translations, second.translations]),
        centers=np.concatenate([first.centers, second.centers]),
        points=np.concatenate([first.points, second.points]),
        keypoints=first.keypoints + second.keypoints,
        keypoint_points=first.keypoint_points
        + tuple(np.where(rows < 0, rows, rows + points) for rows in second.keypoint_points),
        track_offsets=np.r_[first.track_offsets, second.track_offsets[1:] + first.track_offsets[-1]],
        track_image_ids=np.r_[first.track_image_ids, second.track_image_ids + images],
        track_keypoint_ids=np.r_[first.track_keypoint_ids, second.track_keypoint_ids],
        track_outliers=np.r_[first.track_outliers, second.track_outliers],
        pairs=np.concatenate([first.pairs, second.pairs + images]),
        edge_rotations=np.concatenate([first.edge_rotations, second.edge_rotations]),
        edge_translations=np.concatenate([first.edge_translations, second.edge_translations]),
        edge_covariances=np.concatenate([first.edge_covariances, second.edge_covariances]),
        edge_inlier_counts=np.r_[first.edge_inlier_counts, second.edge_inlier_counts],
        edge_angles_deg=np.r_[first.edge_angles_deg, second.edge_angles_deg],
        edge_outliers=np.r_[first.edge_outliers, second.edge_outliers],
        match_offsets=np.r_[first.match_offsets, second.match_offsets[1:] + first.match_offsets[-1]],
        matches=np.concatenate([first.matches, second.matches]),
        match_outliers=np.r_[first.match_outliers, second.match_outliers],
    )


def write_features(made, folder, blocks=2):
    """Features in blocks; red says the block of a keypoint's image, green the image, blue the keypoint."""
    paths = []
    for block in range(blocks):
        ids = np.arange(made.image_count)[block::blocks]
        points = np.concatenate([made.keypoints[i] for i in ids])
        count = len(points)
        path = folder / f"features{block}.h5"
        LocalFeatures(
            image_ids=ids,
            names=[f"{i}.jpg" for i in ids],
            digests=[""] * len(ids),
            sizes=np.tile([640, 480], (len(ids), 1)),
            offsets=np.r_[0, np.cumsum([len(made.keypoints[i]) for i in ids])],
            keypoints=points,
            descriptors=np.zeros((count, 8), np.uint8),
            scores=np.ones(count, np.float32),
            scales=np.ones(count, np.float32),
            angles=np.zeros(count, np.float32),
            colors=np.concatenate([colors_of(made, i, 7 + block) for i in ids]),
        ).write(path, HEADER)
        paths.append(path)
    return paths


def colors_of(made, image, red):
    """Colours (N,3) of an image's keypoints, of which hardly two are the same."""
    rows = np.arange(len(made.keypoints[image]))
    return np.column_stack(np.broadcast_arrays(red, 10 * image, rows % 256)).astype(np.uint8)


def write_geometries(made, folder):
    """Two tiles; the first pair is rejected."""
    paths = []
    rejected = np.r_[3, np.zeros(len(made.pairs) - 1, int)]
    for tile, rows in enumerate((np.arange(0, len(made.pairs), 2), np.arange(1, len(made.pairs), 2))):
        parts = [made.matches[made.match_offsets[r] : made.match_offsets[r + 1]] for r in rows]
        path = folder / f"tile{tile}.h5"
        TwoViewGeometries(
            pairs=made.pairs[rows],
            digests=[""] * len(rows),
            rotations=made.edge_rotations[rows],
            translations=made.edge_translations[rows],
            covariances=made.edge_covariances[rows],
            kinds=np.zeros(len(rows), int),
            rejections=rejected[rows],
            match_counts=np.array([len(p) for p in parts]),
            inlier_counts=np.array([len(p) for p in parts]),
            inlier_ratios=np.ones(len(rows)),
            triangulation_angles_deg=made.edge_angles_deg[rows],
            offsets=np.cumsum([0, *map(len, parts)]),
            inliers=np.concatenate([made.matches[:0], *parts]),
        ).write(path, HEADER)
        paths.append(path)
    return paths
