"""What does not know a picture that lies on its side sees images as their EXIF orientation shows them."""

from contextlib import ExitStack
from dataclasses import replace

import cv2
import numpy as np
import pytest
from image_stages import NAMES, Scene
from random_weights import write_netvlad

from snakesfm.artifacts import GlobalDescriptors, Header, ImageIndex
from snakesfm.config.describe_images import DescribeImagesOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.learned.weights import WEIGHT_FILES
from snakesfm.stages import describe_images
from snakesfm.stages.match_pairs import FeatureFiles

TURN_BACK = {5: cv2.ROTATE_90_CLOCKWISE, 6: cv2.ROTATE_90_COUNTERCLOCKWISE}
COLUMNS = ("descriptors", "scores", "scales", "colors")


@pytest.fixture(params=[5, 6])
def scenes(request, images, tmp_path):
    """The images as they are, and as a camera stores them that tells this orientation."""
    orientation = request.param
    for name in NAMES:
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes((images / name).read_bytes())
        if name != "gone.png":
            pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
            turned = cv2.rotate(pixels, TURN_BACK[orientation])
            stored = cv2.flip(turned, 1) if orientation == 5 else turned
            path.write_bytes(cv2.imencode(".png", stored)[1].tobytes())
    found = []
    for folder, name in ((images, "shown"), (tmp_path / "images", "stored")):
        (tmp_path / name).mkdir()
        found.append(Scene(tmp_path / name, folder, 1))
    index = ImageIndex.read(found[1].file("index"))
    turned = replace(index, orientations=np.full(6, orientation), sizes=index.sizes[:, ::-1])
    turned.write(found[1].file("index"), Header("index_images", 1, "scene"))
    return orientation, *found


def lying(places, orientation):
    """Places of an image of 320 x 240 pixels as shown, as its file has them."""
    return np.column_stack([places[:, 1], 320 - places[:, 0] if orientation == 6 else places[:, 0]])


@pytest.mark.parametrize("method", ["sift", "superpoint"])
def test_keypoints_are_those_of_the_image_as_shown_in_pixels_as_stored(scenes, tmp_path, method):
    orientation, shown, stored = scenes
    options = ExtractFeaturesOptions(method=method, upright=method == "sift", max_keypoints=200)
    settings = {}
    if method == "superpoint":
        pytest.importorskip("transformers", reason="the extra 'deep' is not installed")
        import torch
        from safetensors.torch import save_file

        from snakesfm.features.extraction import DETECTORS

        torch.manual_seed(0)
        network = DETECTORS[method](state=None)._network
        save_file(network.state_dict(), tmp_path / WEIGHT_FILES[method].name)
        settings = {"weights": str(tmp_path), "models": [method], "fetch": ""}
    for scene in (shown, stored):
        scene.extract(options, **settings)
    upright, turned = shown.features(), stored.features()
    for name in NAMES:
        expected = lying(upright[name]["keypoints"], orientation)
        np.testing.assert_allclose(turned[name]["keypoints"], expected, atol=1e-4)
        for column in COLUMNS:
            np.testing.assert_array_equal(turned[name][column], upright[name][column])
    assert len(turned[NAMES[0]]["keypoints"]) > 100

    # a network that matches them sees them where they are shown
    read = []
    for scene in (shown, stored):
        inputs = {"features": scene.block_files("features"), "index": [scene.file("index")]}
        job = scene.job("match_pairs", MatchPairsOptions(method="lightglue"), inputs, [tmp_path / "m.h5"])
        with ExitStack() as stack:
            read.append(FeatureFiles(job, stack).read(0))
    assert read[0].image_size == read[1].image_size == (320, 240)
    np.testing.assert_allclose(read[1].keypoints, read[0].keypoints, atol=1e-4)


def test_images_are_described_as_shown(scenes, tmp_path):
    pytest.importorskip("torch", reason="the extra 'deep' is not installed")
    write_netvlad(tmp_path / "netvlad_pitts30k.mat")
    told = {"block": 0, "weights": str(tmp_path), "models": ["netvlad"], "fetch": ""}
    described = []
    for scene in scenes[1:]:
        output, inputs = scene.file("descriptors"), {"index": [scene.file("index")]}
        options = DescribeImagesOptions(method="netvlad")
        job = scene.job("describe_images", options, inputs, [output], images=str(scene.images), **told)
        describe_images.run(job)
        described.append(GlobalDescriptors.read(output).descriptors)
    np.testing.assert_array_equal(described[1], described[0])
    assert described[0][0].any()
