"""Front-ends beside SIFT, from images to model."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from extras import import_extra
from random_weights import megaloc_state, write_netvlad
from workflow_runner import ROOT, Workflow, config_of, copy_run

from snakesfm.artifacts import (
    GlobalDescriptors,
    ImageIndex,
    ImagePairs,
    LocalFeatures,
    PairCoordinates,
    PairMatches,
    TrackTable,
    TwoViewGeometries,
    ViewGraph,
)
from snakesfm.artifacts.gather import gather_inlier_matches
from snakesfm.artifacts.hloc import read_hloc_matches
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.front_ends import fetch_command
from snakesfm.learned.weights import WEIGHT_FILES

pytestmark = pytest.mark.workflow
DEGREES = ("1", "2.5", "5", "10", "20")


def test_the_oracle_leaves_no_error_to_the_back_end(small_scene: Path, workflow: Workflow) -> None:
    metrics = workflow.metrics_of(small_scene, "front_end=virtual", f"cameras={small_scene / 'reference'}")
    for degrees in DEGREES:
        assert 99.5 <= metrics[f"pose_auc_{degrees}deg"] <= 100
    assert metrics["reference_images_registered"] == 16
    assert metrics["reprojection_error_px_mean"] < 0.01


def test_hlocs_files_go_out_and_come_in_again(finished, small_scene: Path, workflow: Workflow) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run("hloc", *config_of(small_scene, "export_hloc={matches: putative}"))
    assert outcome.status == 0, outcome.text
    assert [rule for rule in outcome.rules if rule != "hloc"] == ["export_hloc"]
    folder = workflow.folder / "out" / "square" / "export_hloc"
    pairs = [line.split() for line in (folder / "pairs.txt").read_text().splitlines()]
    with h5py.File(folder / "features.h5") as features, h5py.File(folder / "matches.h5") as matches:
        assert len(features) == 16
        for first, second in pairs:
            partners = matches[first][second]["matches0"][()]
            assert len(partners) == len(features[first]["keypoints"])
            assert (partners >= 0).sum() > 0 and partners.max() < len(features[second]["keypoints"])

    (workflow.folder / "again").mkdir()
    again = Workflow(workflow.folder / "again")
    # under these names hloc knows none of the images, which is not to be remembered of their pixels
    known = ["scene=square", "output=out", "front_end=imported", f"imported={folder}"]
    astray = again.run("--until", "extract_features", "--config", f"images={small_scene}", *known)
    assert astray.status == 0, astray.text
    metrics = again.metrics_of(small_scene, "scene=square", "front_end=imported", f"imported={folder}")
    assert metrics["reference_images_registered"] == 16
    before = json.loads((finished[0] / "evaluate_model" / "metrics.json").read_text())
    for degrees in ("1", "3", "5"):
        name = f"relative_pose_auc_{degrees}deg"
        assert before[name] - 2 < metrics[name] <= 100
    block = sorted((again.folder / "out" / "square" / "extract_features").glob("*.h5"))[0]
    former = LocalFeatures.read(finished[0] / "extract_features" / block.name)
    np.testing.assert_allclose(LocalFeatures.read(block).keypoints, former.keypoints, atol=1e-3)
    assert read_model(again.folder / "out" / "square" / "export_model").num_reg_images() == 16


def test_hlocs_files_hold_the_inliers_and_give_them_back(
    finished, small_scene: Path, workflow: Workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run("hloc", *config_of(small_scene))
    assert outcome.status == 0, outcome.text
    folder = workflow.folder / "out" / "square" / "export_hloc"
    names = [str(name) for name in ImageIndex.read(finished[0] / "index_images" / "index.h5").names]
    accepted = ViewGraph.read(finished[0] / "build_view_graph" / "graph.h5").pairs
    pairs, offsets, inliers = gather_inlier_matches(
        sorted((finished[0] / "estimate_two_view").glob("*.h5")), accepted
    )
    listed = [tuple(line.split()) for line in (folder / "pairs.txt").read_text().splitlines()]
    assert listed == [(names[i], names[j]) for i, j in pairs.tolist()] and len(listed) > 30
    with h5py.File(folder / "features.h5") as features, h5py.File(folder / "matches.h5") as file:
        for row, pair in enumerate(listed):
            counts = tuple(len(features[name]["keypoints"]) for name in pair)
            expected = inliers[offsets[row] : offsets[row + 1]]
            matches, scores = read_hloc_matches(file, pair, counts)
            np.testing.assert_array_equal(matches, expected[np.argsort(expected[:, 0])])
            turned, _ = read_hloc_matches(file, pair[::-1], counts[::-1])
            np.testing.assert_array_equal(turned[np.argsort(turned[:, 1]), ::-1], matches)
            assert (scores > 0).all() and (scores <= 1).all()


def test_missing_weights_end_the_run_with_one_sentence(small_scene: Path, workflow: Workflow) -> None:
    import_extra("torch")
    outcome = workflow.run(
        "--config", f"images={small_scene / 'images'}", "output=out", "front_end=xfeat+lighterglue"
    )
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    sentence = next(line for line in outcome.summary if "failed" in line)
    assert f"'{fetch_command('xfeat+lighterglue', {}, 'weights')}" in sentence


def test_the_weights_are_fetched_by_their_own_target(
    small_scene: Path, workflow: Workflow, weights: Path
) -> None:
    # neither images nor an output folder are needed
    command = shlex.split(fetch_command("xfeat+lighterglue", {}, "weights"))
    done = subprocess.run(
        [sys.executable, "-m", *command, "images=nowhere", "--snakefile", str(ROOT / "Snakefile")],
        cwd=workflow.folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "no model yet" not in done.stdout
    assert sorted(path.name for path in workflow.folder.iterdir()) == [".snakemake", "weights"]
    names = sorted(path.name for path in (workflow.folder / "weights").iterdir())
    assert names == ["SHA256SUMS", "xfeat-lighterglue.pt", "xfeat.pt"]
    for name in names[1:]:
        assert (workflow.folder / "weights" / name).read_bytes() == (weights / name).read_bytes()


def write_random_superpoint(folder: Path, matcher: str) -> None:
    """Random weights of SuperPoint and of a matcher of its keypoints, as their makers store them."""
    torch = import_extra("torch")
    import_extra("transformers")
    from safetensors.torch import save_file

    from snakesfm.features.extraction import DETECTORS
    from snakesfm.matching.matcher import MATCHERS

    folder.mkdir()
    torch.manual_seed(0)
    networks = {
        "superpoint": DETECTORS["superpoint"](state=None),
        f"superpoint_{matcher}": MATCHERS[matcher](detector="superpoint", min_score=0.0, state=None),
    }
    for model, made in networks.items():
        path = folder / WEIGHT_FILES[model].name
        if path.suffix == ".safetensors":
            save_file(made._network.state_dict(), path)
        else:
            torch.save(made._network.state_dict(), path)


# each job with a network loads torch
@pytest.mark.parametrize(
    ("method", "batch_size", "blocks"), [("superglue", 5, 1), ("lightglue", "auto", 2)]
)
def test_superpoint_and_its_matchers_run_until_nothing_fits_with_random_weights(
    small_scene: Path, workflow: Workflow, method: str, batch_size: int | str, blocks: int
) -> None:
    write_random_superpoint(workflow.folder / "weights", method)
    outcome = workflow.run(
        "--config",
        f"images={small_scene / 'images'}",
        "output=out",
        f"front_end=superpoint+{method}",
        f"batch_size={batch_size}",
        f"blocks={blocks}",
        "extract_features={max_keypoints: 64, max_shorter_side_px: 150}",
        "select_pairs={method: sequential, look_ahead: 1}",
        "match_pairs={min_score: 0.0}",
    )
    # matches of random networks fit no camera, which is said in one sentence
    assert outcome.status != 0
    assert "Traceback" not in outcome.text and outcome.rules[-1] == "build_view_graph"
    said = [line for line in outcome.summary if "build_view_graph" in line]
    sentence = "No two images of scene 'square' overlap well enough (15 pairs were tried)"
    assert said and all(sentence in line for line in said)
    out = workflow.folder / "out" / "square"
    features = [LocalFeatures.read(path) for path in sorted((out / "extract_features").glob("*.h5"))]
    assert len(features) == blocks and sum(len(block.image_ids) for block in features) == 16
    for block in features:
        assert block.descriptors.dtype == np.float16 and block.descriptors.shape[1] == 256
        assert (np.diff(block.offsets) == 64).all()
    tiles = [PairMatches.read(path) for path in sorted((out / "match_pairs").glob("*.h5"))]
    assert sum(len(tile.pairs) for tile in tiles) == 15
    assert all((np.diff(tile.offsets) > 0).all() for tile in tiles)
    tried = [TwoViewGeometries.read(path) for path in sorted((out / "estimate_two_view").glob("*.h5"))]
    assert sum(len(tile.pairs) for tile in tried) == 15
    assert all((tile.rejections > 0).all() for tile in tried)


def test_places_found_pair_by_pair_are_merged(
    small_scene: Path, workflow: Workflow, tmp_path: Path
) -> None:
    config = ["front_end=virtual_places", f"cameras={small_scene / 'reference'}"]
    metrics = workflow.metrics_of(small_scene, *config)
    assert metrics["reference_images_registered"] == 16
    # places are off by up to two pixels of a small image
    assert 85 < metrics["pose_auc_1deg"] < 99.9 and 97 < metrics["pose_auc_5deg"] < 100
    assert 3.5 < metrics["track_length_mean"] < 8
    out = workflow.folder / "out" / "square"
    tracks = TrackTable.read(out / "build_tracks" / "tracks.h5")
    before, after = tracks.lengths_unmerged, tracks.lengths_merged
    # nearly every track of two images: what must not reach the model
    assert before[2] > 0.99 * before.sum() > 1000
    assert after[2] < 0.3 * after.sum() and after @ np.arange(len(after)) > 3.5 * after.sum()
    page = (out / "render_report" / "index.html").read_text("utf-8")
    assert "inlier matches before merging keypoints" in page and "after merging" in page

    # other blocks and other pairs' places stay what they were
    (tmp_path / "blocks").mkdir()
    other = Workflow(tmp_path / "blocks")
    assert other.metrics_of(small_scene, *config, "blocks=3") == metrics
    by_image = [
        {
            (str(name), block.keypoints[block.offsets[row] : block.offsets[row + 1]].tobytes())
            for path in sorted((folder / "merge_keypoints").glob("*.h5"))
            for block in [LocalFeatures.read(path)]
            for row, name in enumerate(block.names)
        }
        for folder in (out, other.folder / "out" / "square")
    ]
    assert by_image[0] == by_image[1] and len(by_image[0]) == 16

    # another radius matches nothing anew, and a lost tile is taken over from its former file
    other_radius = config_of(small_scene, *config, "merge_keypoints={radius_px: 2}")
    outcome = workflow.run("--until", "index_matches", *other_radius)
    assert outcome.status == 0, outcome.text
    assert set(outcome.rules) == {"merge_keypoints", "index_matches"}
    (out / "match_pairs" / "0-1.h5").unlink()
    again = workflow.run("--until", "match_pairs", *config_of(small_scene, *config))
    assert again.status == 0, again.text
    assert "64 pairs (64 taken over)" in (out / "logs" / "match_pairs" / "0-1.log").read_text()


def test_loftr_runs_through_with_random_weights(small_scene: Path, workflow: Workflow) -> None:
    torch = import_extra("torch")
    import_extra("kornia")
    from snakesfm.matching.detector_free import DETECTOR_FREE_MATCHERS

    (workflow.folder / "weights").mkdir()
    torch.manual_seed(1)
    network = DETECTOR_FREE_MATCHERS["loftr"](min_score=0.0, longer_side_px=128, state=None)._network
    torch.save({"state_dict": network.state_dict()}, workflow.folder / "weights" / "loftr_outdoor.ckpt")
    outcome = workflow.run(
        "--until",
        "index_matches",
        "--config",
        f"images={small_scene / 'images'}",
        "output=out",
        "front_end=loftr",
        "blocks=1",
        "select_pairs={method: sequential, look_ahead: 1}",
        "match_pairs={min_score: 0.0, longer_side_px: 128}",
    )
    assert outcome.status == 0, outcome.text
    # keypoints are found by no detector
    assert "extract_features" not in outcome.rules
    out = workflow.folder / "out" / "square"
    found = [PairCoordinates.read(path) for path in sorted((out / "match_pairs").glob("*.h5"))]
    tiles = [PairMatches.read(path) for path in sorted((out / "index_matches").glob("*.h5"))]
    assert sum(len(tile.pairs) for tile in tiles) == 15
    assert sum(len(tile.scores) for tile in found) > 15
    for coordinates, tile in zip(found, tiles, strict=True):
        np.testing.assert_array_equal(coordinates.pairs, tile.pairs)
        assert (np.diff(tile.offsets) <= np.diff(coordinates.offsets)).all()


@pytest.mark.parametrize("method", ["netvlad", "megaloc"])
def test_images_are_described_by_networks_with_random_weights(
    small_scene: Path, workflow: Workflow, method: str
) -> None:
    torch = import_extra("torch")
    import_extra("transformers")
    (workflow.folder / "weights").mkdir()
    path = workflow.folder / "weights" / WEIGHT_FILES[method].name
    if method == "netvlad":
        write_netvlad(path)
    else:
        torch.save(megaloc_state(), path)
    config = [
        "select_pairs={method: retrieval, top_k: 2, preview_keypoints: 0}",
        f"describe_images={{method: {method}}}",
    ]
    config += [f"images={small_scene / 'images'}", "output=out", "blocks=1"]
    outcome = workflow.run("--until", "select_pairs", "--config", *config)
    assert outcome.status == 0, outcome.text
    # no keypoints and no vocabulary are needed to choose pairs
    assert set(outcome.rules) == {"index_images", "describe_images", "select_pairs"}
    out = workflow.folder / "out" / "square"
    blocks = [GlobalDescriptors.read(path) for path in sorted((out / "describe_images").glob("*.h5"))]
    assert sum(len(block.image_ids) for block in blocks) == 16
    for block in blocks:
        # up to rounding to multiples of 1/2048
        longest = np.sqrt(block.descriptors.shape[1]) / 4096
        np.testing.assert_allclose(np.linalg.norm(block.descriptors, axis=1), 1, atol=longest)
    tiles = [ImagePairs.read(path) for path in sorted((out / "select_pairs").glob("*.h5"))]
    assert 16 <= sum(len(tile.pairs) for tile in tiles) <= 32
