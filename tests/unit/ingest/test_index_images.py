import os

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from snakesfm.artifacts.base import read_header
from snakesfm.artifacts.images import ImageIndex
from snakesfm.blocks import deal_blocks
from snakesfm.config.index_images import IndexImagesOptions
from snakesfm.errors import SceneError
from snakesfm.ingest.discover import digest_images
from snakesfm.stages.index_images import run
from snakesfm.stages.job import StageJob


def index(tmp_path, images, cameras="", threads=2, **options):
    out = tmp_path / "results" / "scene" / "index_images" / "index.h5"
    settings = {"images": str(images), "cameras": str(cameras), "blocks": 3}
    run(
        StageJob(
            "index_images", "scene", {}, (out,), IndexImagesOptions(**options), settings, threads=threads
        )
    )
    return ImageIndex.read(out)


def draw(path, seed, size=(96, 64), **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, **options)


@pytest.fixture
def folder(tmp_path):
    images = tmp_path / "images"
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model], exif[ExifTags.Base.Orientation] = (
        "DJI",
        "FC6310",
        6,
    )
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = IFDRational(88, 10)
    draw(images / "b#{x}.jpg", 2, exif=exif)
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(
        {
            ExifTags.GPS.GPSLatitudeRef: "S",
            ExifTags.GPS.GPSLatitude: (IFDRational(33), IFDRational(30), IFDRational(18)),
            ExifTags.GPS.GPSLongitudeRef: "W",
            ExifTags.GPS.GPSLongitude: (IFDRational(70), IFDRational(45), IFDRational(0)),
            ExifTags.GPS.GPSAltitude: IFDRational(125, 10),
        }
    )
    draw(images / "a b.JPG", 1, exif=exif)
    draw(images / "left" / "1.png", 3)
    draw(images / "right" / "1.png", 4)
    (images / "right" / "copy.png").write_bytes((images / "left" / "1.png").read_bytes())
    (images / "text.jpg").write_text("no picture")
    (images / "zero.png").touch()
    whole = (images / "a b.JPG").read_bytes()
    (images / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    return images


def test_index_of_a_mixed_folder(tmp_path, folder, capsys):
    found = index(tmp_path, folder)
    assert found.names.tolist() == ["a b.JPG", "b#{x}.jpg", "left/1.png", "right/1.png", "right/copy.png"]
    assert found.sizes.tolist() == [[96, 64]] * 5
    assert found.orientations.tolist() == [6, 6, 1, 1, 1]
    np.testing.assert_allclose(found.gps[0], (-33.505, -70.75, 12.5))
    assert np.isnan(found.gps[1:]).all()
    assert found.duplicate_of.tolist() == [-1, -1, -1, -1, 2]
    assert found.blocks.tolist() == deal_blocks(found.names.tolist(), 3)
    assert found.sha256.tolist() == list(digest_images(folder, found.names.tolist()).values())
    assert found.camera_ids.tolist() == [0, 0, 1, 2, 2]
    assert found.camera_sources.tolist() == ["exif", "default", "default"]
    np.testing.assert_allclose(found.camera_params[0, 0], 96 * 8.8 / 13.2, rtol=1e-5)
    assert found.refused_names.tolist() == ["cut.jpg", "text.jpg", "zero.png"]
    printed = capsys.readouterr().out.splitlines()
    assert [line.startswith("warning: ") for line in printed] == [True] * 4 + [False]
    assert printed[-1] == "5 images, 3 cameras (2 default, 1 exif), 3 refused"


def test_same_bytes_whatever_the_threads(tmp_path, folder):
    index(tmp_path / "one", folder, threads=1)
    index(tmp_path / "two", folder, threads=4)
    name = "results/scene/index_images/index.h5"
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_the_header_names_the_image_folder_whatever_its_bytes(tmp_path):
    odd = tmp_path / os.fsdecode(b"f\xfcr")
    for seed in (1, 2):
        draw(odd / f"{seed}.png", seed)
    (tmp_path / "link").symlink_to(odd)
    index(tmp_path, tmp_path / "link")
    header = read_header(tmp_path / "results" / "scene" / "index_images" / "index.h5")
    assert header["images"] == f"{tmp_path.resolve()}/f\\udcfcr"
    assert str(odd) not in header["settings"]


def test_known_cameras_and_options(tmp_path, folder):
    (tmp_path / "K.txt").write_text("80 0 48\n0 80 32\n0 0 1\n")
    found = index(tmp_path, folder, tmp_path / "K.txt")
    assert found.camera_models.tolist() == ["PINHOLE"]
    assert found.camera_sources.tolist() == ["given"]
    assert found.camera_params[0, :4].tolist() == [80, 80, 48, 32]
    assert np.isnan(found.camera_params[0, 4:]).all()
    found = index(tmp_path, folder, camera_sharing="per_image", camera_model="OPENCV")
    assert found.camera_ids.tolist() == [0, 1, 2, 3, 4]
    assert set(found.camera_models) == {"OPENCV"}
    found = index(tmp_path, folder, use_exif_focal=False, default_focal_ratio=2.0)
    assert set(found.camera_sources) == {"default"}
    assert found.camera_params[:, 0].tolist() == [192.0] * 3


def test_what_is_doubtful_of_cameras_is_kept_and_told(tmp_path, folder, capsys):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 96 64 80 80 48 32\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 left/1.png\n\n")
    found = index(tmp_path, folder, tmp_path / "cameras.txt")
    assert found.camera_ids.tolist() == [0, 0, 1, 1, 1]
    assert found.camera_sources.tolist() == ["exif", "given"]
    (line,) = found.warnings
    start = f"2 images not listed in {tmp_path / 'images.txt'} were assigned camera 1 by their size"
    assert line.startswith(start)
    assert f"warning: {line}" in capsys.readouterr().out.splitlines()
    found = index(tmp_path, folder, camera_sharing="exif")
    assert found.camera_ids.tolist() == [0, 0, 1, 2, 3]
    assert [line.split(":")[0] for line in found.warnings] == ["3 images have a camera of their own"]
    assert index(tmp_path, folder, camera_sharing="per_image").warnings.tolist() == []


def test_too_few_images_end_with_one_sentence(tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    with pytest.raises(SceneError, match="contains no JPEG, PNG, TIFF, WebP or BMP image"):
        index(tmp_path, images)
    (images / "text.jpg").write_text("no picture")
    with pytest.raises(SceneError, match=r"no usable image.*1 refused, first: .*text\.jpg"):
        index(tmp_path, images)
    assert "warning: " in capsys.readouterr().out
    draw(images / "a.png", 1)
    with pytest.raises(SceneError, match="At least two images"):
        index(tmp_path, images)
    (images / "b.png").write_bytes((images / "a.png").read_bytes())
    with pytest.raises(SceneError, match="only one usable image \\(or copies of it\\)"):
        index(tmp_path, images)
    draw(images / "c.png", 2)
    assert len(index(tmp_path, images).names) == 3


def test_name_that_is_not_utf8_is_refused(tmp_path, folder):
    (folder / "left" / "1.png").rename(folder / "left" / "\udcff.png")
    found = index(tmp_path, folder)
    assert "left/\\udcff.png" in found.refused_names
    assert len(found.names) == 4


@pytest.mark.parametrize(
    ("name", "counts", "focal_ratio"),
    [
        ("seneca_aerial_167", {"exif": 1}, (0.95, 1.05)),
        ("sceaux_castle_11", {"exif": 1}, (0.95, 1.05)),
        ("alexander_bust_57", {"default": 57}, (0.5, 1.3)),
        ("imc_reichstag_10", {"default": 10}, (0.6, 1.8)),
        ("strecha_castle_p30", {"default": 1}, (1.2, 1.4)),
    ],
)
def test_real_sets(tmp_path, data, name, counts, focal_ratio):
    reference = index(tmp_path / "given", data / name / "images", data / name / "reference")
    found = index(tmp_path / "unknown", data / name / "images")
    sources, numbers = np.unique(found.camera_sources, return_counts=True)
    assert dict(zip(sources, numbers, strict=True)) == counts
    given = reference.camera_sources[reference.camera_ids] == "given"
    ratio = found.camera_params[found.camera_ids, 0] / reference.camera_params[reference.camera_ids, 0]
    assert focal_ratio[0] < np.median(ratio[given]) < focal_ratio[1]
