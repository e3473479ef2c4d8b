"""Stage export_hloc: image names that hloc cannot read are said."""

import io

import numpy as np
import pytest
from plain_artifacts import write_plain_index, write_plain_matches

from snakesfm.artifacts import Header, LocalFeatures, TwoViewGeometries
from snakesfm.config.export_hloc import ExportHlocOptions
from snakesfm.stages import export_hloc
from snakesfm.stages.job import StageJob


def export(folder, names, pairs, terminal=None):
    """The stage on images of two keypoints, of which each pair matches the first."""
    count = len(names)
    header = Header("stage", 1, "scene")
    index, features, matches, geometries = (folder / f"{name}.h5" for name in "ifmg")
    write_plain_index(index, names, [(320, 240)] * count)
    LocalFeatures(
        image_ids=np.arange(count),
        names=names,
        digests=names,
        sizes=np.tile([320, 240], (count, 1)),
        offsets=np.arange(count + 1) * 2,
        keypoints=np.tile([[10.5, 20.5], [30.5, 40.5]], (count, 1)),
        descriptors=np.zeros((2 * count, 128), np.uint8),
        scores=np.ones(2 * count),
        scales=np.ones(2 * count),
        angles=np.zeros(2 * count),
        colors=np.zeros((2 * count, 3), np.uint8),
    ).write(features, header)
    rows = len(pairs)
    write_plain_matches(matches, pairs, np.zeros((rows, 1, 2), int))
    TwoViewGeometries(
        pairs=pairs,
        digests=[""] * rows,
        rotations=np.full((rows, 3, 3), np.nan),
        translations=np.full((rows, 3), np.nan),
        covariances=np.full((rows, 5, 5), np.nan),
        kinds=np.zeros(rows, np.int8),
        rejections=np.ones(rows, np.int8),
        match_counts=np.ones(rows, int),
        inlier_counts=np.zeros(rows, int),
        inlier_ratios=np.zeros(rows),
        triangulation_angles_deg=np.zeros(rows),
        offsets=np.zeros(rows + 1, int),
        inliers=np.zeros((0, 2), int),
    ).write(geometries, header)
    export_hloc.run(
        StageJob(
            stage="export_hloc",
            scene="scene",
            inputs={"index": index, "features": features, "matches": matches, "geometries": geometries},
            outputs=tuple(folder / name for name in ("features.h5", "matches.h5", "pairs.txt")),
            options=ExportHlocOptions(matches="putative"),
            terminal=terminal,
        )
    )
    return (folder / "pairs.txt").read_text("utf-8")


@pytest.mark.parametrize("name", ["b 1.jpg", "my photos/b.jpg", "b\u00a01.jpg"])
def test_names_with_spaces_are_warned_of_in_the_log_and_on_the_terminal(name, tmp_path, capsys):
    terminal = io.StringIO()
    assert export(tmp_path, ["a.jpg", name], [[0, 1]], terminal) == f"a.jpg {name}\n"
    assert f"warning: {export_hloc.SPACES}\n" in capsys.readouterr().err
    assert terminal.getvalue() == f"snakesfm: scene 'scene': warning: {export_hloc.SPACES}\n"


def test_other_names_give_no_warning(tmp_path, capsys):
    assert export(tmp_path, ["a.jpg", "b_1.jpg", "not matched.jpg"], [[0, 1]]) == "a.jpg b_1.jpg\n"
    assert "warning" not in capsys.readouterr().err
