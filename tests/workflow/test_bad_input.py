"""What users feed it: every bad folder ends well or with one clear sentence, never a traceback."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.workflow


def photographs(scene: Path, count: int | None = None) -> list[Path]:
    return sorted((scene / "images").iterdir())[:count]


def fill(folder: Path, files: list[Path]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        shutil.copy(file, folder / file.name)
    return folder


def summary_of(folder: Path, scene: str) -> dict:
    return json.loads((folder / "out" / scene / "export_model" / "summary.json").read_text())


def texture(seed: int) -> Image.Image:
    """An image with many corners that shares nothing with one of another seed."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)
    return Image.fromarray(small).resize((400, 300), Image.Resampling.BICUBIC)


@pytest.mark.parametrize(
    ("config", "parts"),
    [
        (["images=nowhere"], ["nowhere", "does not exist", "images=PATH"]),
        (["images=empty", "imagse=x"], ["imagse", "did you mean 'images'"]),
        (["images="], ["'images' has no value"]),
        (["images=photos", "output=."], ["its own image folder 'photos'", "scene=NAME"]),
        (["images=100_0042"], ["images=100_0042 as the number 1000042", "images=./100_0042"]),
    ],
)
def test_a_wrong_call_gives_one_sentence(
    workflow, small_scene, config: list[str], parts: list[str]
) -> None:
    (workflow.folder / "empty").mkdir()
    fill(workflow.folder / "photos", photographs(small_scene, 2))
    outcome = workflow.run("--config", "output=out", *config)
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert outcome.rules == []
    for part in parts:
        assert part in outcome.text
    assert not list(workflow.folder.glob("out/*/*/*.h5"))


def test_a_quiet_call_gives_its_sentence_too(workflow) -> None:
    telephone = workflow.folder / "telephone"
    telephone.mkdir()
    (telephone / "IMG_1.HEIC").write_bytes(b"what telephones write")
    outcome = workflow.run("--quiet", "all", "--config", "output=out", "images=telephone")
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert outcome.text.count("convert files such as 'IMG_1.HEIC' to JPEG (1 files)") == 1


def test_records_in_a_database_are_refused_before_the_images_are_looked_at(workflow) -> None:
    outcome = workflow.run("--persistence-backend", "db", "--config", "output=out", "images=nowhere")
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert "--persistence-backend db keeps none: leave out this option" in outcome.text


def test_one_image_is_too_few(workflow, small_scene: Path) -> None:
    fill(workflow.folder / "one", photographs(small_scene, 1))
    outcome = workflow.run("--config", "images=one", "output=out")
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert any("failed" in line and "two images" in line for line in outcome.summary)


def test_two_images_are_enough(workflow, small_scene: Path) -> None:
    fill(workflow.folder / "two", photographs(small_scene, 2))
    outcome = workflow.run("--config", "images=two", "output=out")
    assert outcome.status == 0, outcome.text
    summary = summary_of(workflow.folder, "two")
    assert summary["registered_images"] == 2
    assert summary["points"] > 50
    assert 0.02 < summary["mean_reprojection_error_px"] < 1.5


def test_images_without_overlap_end_with_one_sentence(workflow) -> None:
    folder = workflow.folder / "strangers"
    folder.mkdir()
    for seed in range(3):
        texture(seed).save(folder / f"{seed}.png")
    outcome = workflow.run("--config", "images=strangers", "output=out")
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert any("failed" in line and "overlap" in line for line in outcome.summary), outcome.summary


def test_names_and_files_of_all_kinds(workflow, small_scene: Path) -> None:
    """One run with everything that real folders hold; only what is damaged is left out."""
    folder = workflow.folder / "Fotos von heute"
    source = photographs(small_scene)
    names = [
        "with space.jpg",
        "ünïcödé 写真.jpg",
        "hash#tag.JPG",
        "brace{scene}.JPEG",
        "sub/same.jpg",
        "other/same.jpg",
        "{}.jpg",
        "quote'\".jpg",
    ]
    for name, file in zip(names, source, strict=False):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, folder / name)
    Image.open(source[8]).save(folder / "png.PNG")
    Image.open(source[9]).convert("L").save(folder / "gray.tif")
    Image.open(source[10]).convert("RGBA").save(folder / "alpha.webp", lossless=True)
    Image.open(source[11]).convert("CMYK").save(folder / "cmyk.tiff")
    gray = np.asarray(Image.open(source[12]).convert("L"))
    Image.fromarray(gray.astype(np.uint16) * 257).save(folder / "sixteen.png")
    shutil.copy(source[3], folder / "twin of brace.jpg")
    (folder / "truncated.jpg").write_bytes(source[13].read_bytes()[:9000])
    (folder / "text.jpg").write_text("this is no image")
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "folder.jpg").mkdir()
    (folder / "notes.txt").write_text("not looked at")
    (folder / "IMG_1.HEIC").write_bytes(b"what telephones write")
    (folder / "png.NEF").write_bytes(b"raw, beside its png")
    outcome = workflow.run("--config", "images=Fotos von heute", "output=out put")
    assert outcome.status == 0, outcome.text
    scene = workflow.folder / "out put" / "Fotos von heute"
    summary = json.loads((scene / "export_model" / "summary.json").read_text())
    assert summary["images"] == 14
    # the twin is left out, as the report says
    assert summary["not_registered"] == ["twin of brace.jpg"]
    assert any("1 images are exact copies of others" in line for line in outcome.summary)
    log = (scene / "logs" / "index_images" / "job.log").read_text()
    assert "png.NEF" not in log
    assert any("warning: 4 image files could not be used" in line for line in outcome.summary)
    for name in ("truncated.jpg", "text.jpg", "empty.jpg", "IMG_1.HEIC"):
        assert any(name in line and "warning" in line.lower() for line in log.splitlines())
    frames = json.loads((scene / "export_model" / "transforms.json").read_text())["frames"]
    for frame in frames:
        assert (scene / "export_model" / frame["file_path"]).is_file()
    report = (scene / "render_report" / "index.html").read_text()
    assert "truncated.jpg" in report
    assert "which is used instead" in report


def test_two_groups_that_do_not_meet_give_the_larger_one(workflow, small_scene: Path) -> None:
    folder = fill(workflow.folder / "groups", photographs(small_scene, 6))
    base = texture(5).resize((1200, 900), Image.Resampling.BICUBIC)
    for step in range(3):
        base.transform(
            (400, 300), Image.Transform.AFFINE, (1.0, 0.02 * step, 300 + 12 * step, 0.01 * step, 1.0, 200)
        ).save(folder / f"zz{step}.png")
    outcome = workflow.run("--config", "images=groups", "output=out")
    assert outcome.status == 0, outcome.text
    assert summary_of(workflow.folder, "groups")["registered_images"] == 6
    assert "6 of 9 images" in outcome.summary[-1]


def test_an_output_folder_that_cannot_be_written_gives_one_sentence(workflow, small_scene: Path) -> None:
    fill(workflow.folder / "two", photographs(small_scene, 2))
    (workflow.folder / "file").write_text("a file, where a folder is wanted")
    outcome = workflow.run("--config", "images=two", "output=file/out")
    assert outcome.status != 0
    assert "Traceback" not in outcome.text
    assert "file/out" in outcome.text
