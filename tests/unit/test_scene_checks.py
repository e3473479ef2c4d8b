"""What is refused before a scene's first job: keys without effect, and paths of the wrong kind."""

import struct
import tempfile
from pathlib import Path

import pytest
from PIL import Image
from users import without_root

from snakesfm.errors import ConfigError
from snakesfm.plan import Plan
from snakesfm.scene_checks import check_results
from snakesfm.scene_plan import ScenePlan
from snakesfm.stages import index_images
from snakesfm.stages.job import StageJob

MATRIX = "500 0 320\n0 500 240\n0 0 1\n"
CAMERAS = "# Camera list\n1 PINHOLE 640 480 500 500 320 240\n"
MODEL = ("cameras", "images", "points3D")


def plan_of(tmp_path: Path, **config: object) -> Plan:
    """A plan of three images in a folder, with the paths of the configuration below ``tmp_path``."""
    images = tmp_path / "photos"
    images.mkdir(exist_ok=True)
    for number in range(3):
        # bytes with which a JPEG begins
        (images / f"{number}.jpg").write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF%d" % number)
    (tmp_path / "pairs.txt").write_text("0.jpg 1.jpg\n")
    (tmp_path / "K.txt").write_text(MATRIX)
    (tmp_path / "hloc").mkdir(exist_ok=True)
    (tmp_path / "model").mkdir(exist_ok=True)
    for part in MODEL:
        (tmp_path / "model" / f"{part}.txt").write_text(CAMERAS if part == "cameras" else "")
    paths = ("cameras", "reference", "pairs", "imported")
    full = {key: str(tmp_path / str(value)) if key in paths else value for key, value in config.items()}
    return Plan({"images": str(images), "output": str(tmp_path / "out"), **full})


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"imported": "hloc"}, r"imported=.*hloc, which .* set front_end=imported or remove imported="),
        ({"imported": "hloc", "front_end": "loftr"}, r"set front_end=imported or remove imported="),
        (
            {"front_end": "sift", "extract_features": {"method": "aliked"}},
            r"front_end=sift means extract_features\.method 'sift', but .* 'aliked': remove front_end",
        ),
        (
            {"front_end": "aliked+lightglue", "match_pairs": {"method": "superglue"}},
            r"front_end=aliked\+lightglue means match_pairs\.method 'lightglue', but .* 'superglue'",
        ),
        (
            {"front_end": "loftr", "extract_features": {"method": "disk"}},
            r"remove front_end and set both .* or remove extract_features\.method\.$",
        ),
        (
            {"pairs": "pairs.txt", "select_pairs": {"method": "exhaustive"}},
            r"pairs=.*select_pairs\.method 'exhaustive' does not read it: .*'listed' or remove pairs=",
        ),
        ({"intrinsics": "refine"}, r"intrinsics=refine.*set cameras=PATH or remove intrinsics="),
        ({"select_pairs": {"method": "listed"}}, r"'listed', but .* has no list of pairs: set pairs=FILE"),
    ],
)
def test_keys_that_would_do_nothing_are_refused(
    config: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        plan_of(tmp_path, **config)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "config",
    [
        {"imported": "hloc", "front_end": "imported"},
        {"imported": "hloc", "extract_features": {"method": "imported"}},
        {"front_end": "aliked+lightglue", "extract_features": {"method": "aliked"}},
        # what config.yaml says of every run
        {
            "front_end": "aliked+lightglue",
            "extract_features": {"method": "sift"},
            "match_pairs": {"method": "mutual_ratio"},
        },
        {"extract_features": {"method": "aliked"}, "match_pairs": {"method": "mutual_ratio"}},
        {"pairs": "pairs.txt"},
        {"pairs": "pairs.txt", "select_pairs": {"method": "listed"}},
        {"cameras": "K.txt", "intrinsics": "refine"},
        {"cameras": "model", "reference": "model"},
        {"cameras": "model/cameras.txt"},
        {"front_end": "virtual", "reference": "model", "cameras": "model"},
    ],
)
def test_keys_that_belong_together_are_taken(config: dict[str, object], tmp_path: Path) -> None:
    assert len(plan_of(tmp_path, **config).scenes) == 1


def test_one_scene_may_lack_what_another_has(tmp_path: Path) -> None:
    plan_of(tmp_path)
    photos, output = str(tmp_path / "photos"), str(tmp_path / "out")
    known = {"images": photos, "cameras": str(tmp_path / "K.txt"), "intrinsics": "refine"}
    assert len(Plan({"output": output, "scenes": {"a": known, "b": {"images": photos}}}).scenes) == 2
    with pytest.raises(ConfigError, match="Scene 'b' has intrinsics=refine"):
        scenes = {"a": known, "b": {"images": photos, "intrinsics": "refine"}}
        Plan({"output": output, "scenes": scenes})


@pytest.mark.parametrize(
    ("key", "path", "message"),
    [
        ("cameras", "nowhere.txt", "does not exist: correct the path"),
        ("reference", "nowhere", "does not exist: correct the path"),
        ("pairs", "hloc", "is not a file: give a text file"),
        ("cameras", "photos/0.jpg", "is neither a COLMAP cameras file nor a 3x3 matrix"),
        ("cameras", "photos", r"contains none of cameras\.bin, cameras\.txt, K\.txt"),
        ("cameras", "pairs.txt", "is neither a COLMAP cameras file nor a 3x3 matrix"),
        ("cameras", "other.bin", "is neither a COLMAP cameras file nor a 3x3 matrix"),
        ("reference", "photos", "does not contain a COLMAP model"),
        ("reference", "photos/0.jpg", "does not contain a COLMAP model"),
        ("reference", "model/images.txt", "does not contain a COLMAP model"),
    ],
)
def test_a_path_of_another_kind_is_refused(key: str, path: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "other.bin").write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF" * 9)
    with pytest.raises(ConfigError, match=f"given as {key}= for scene 'photos', {message}") as refused:
        plan_of(tmp_path, **{key: path})
    assert "\n" not in str(refused.value)


def test_results_may_not_lie_among_the_images(tmp_path: Path) -> None:
    images = str(tmp_path / "photos")
    with pytest.raises(ConfigError, match=r"photos/out' is inside the image folder .*another output=DIR"):
        plan_of(tmp_path, output=f"{images}/out")


def test_results_are_of_the_folder_that_was_indexed(tmp_path: Path) -> None:
    def scene_of(images: Path, **config: object) -> ScenePlan:
        images.mkdir(parents=True, exist_ok=True)
        for name in "ab":
            Image.new("L", (64, 48), ord(name)).save(images / f"{name}.png")
        (scene,) = Plan({"images": str(images), "output": str(tmp_path / "out"), **config}).scenes.values()
        return scene

    first = scene_of(tmp_path / "1" / "photos")
    check_results(first)
    settings = {"images": str(first.images), "blocks": 2}
    index = first.folder / "index_images" / "index.h5"
    options = first.options("index_images")
    index_images.run(StageJob("index_images", first.name, {}, (index,), options, settings))
    check_results(first)
    (tmp_path / "3").symlink_to(tmp_path / "1")
    check_results(scene_of(tmp_path / "3" / "photos"))
    other = tmp_path / "2" / "photos"
    with pytest.raises(ConfigError, match=r"results of '.*/1/photos': set scene=NAME .*scene=photos"):
        check_results(scene_of(other))
    check_results(scene_of(other, scene="photos"))
    listed = Plan({"output": str(tmp_path / "out"), "scenes": {"photos": {"images": str(other)}}})
    check_results(listed.scenes["photos"])
    # moved photographs
    (tmp_path / "1" / "photos").rename(tmp_path / "moved")
    check_results(scene_of(other))


@pytest.mark.parametrize(("images", "hint"), [("demo/images", True), ("photos/images", False)])
def test_how_to_make_the_demo_is_said_where_it_is_missing(
    images: str, hint: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=f"'{images}' does not exist") as refused:
        Plan({"images": images})
    assert ("make demo" in str(refused.value)) == hint


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize(
    ("files", "images", "message"),
    [
        ([], "nowhere", "does not exist: "),
        (
            ["a.zip"],
            "a.zip",
            r"is a file: give the folder .* \(unpack an archive; extract a video's frames",
        ),
        (["a/notes.txt"], "a", "contains no JPEG, PNG, TIFF, WebP or BMP image: "),
        (["a/b/1.MOV", "a/2.mp4"], "a", r"no .* image: extract .* such as '2\.mp4', .* \(2 files\)\.$"),
        (["a/1.HEIC", "a/2.mov"], "a", r"no .* image: convert .* such as '1\.HEIC' to JPEG \(1 files\)\.$"),
    ],
)
def test_what_to_do_where_there_are_no_images(
    files: list[str], images: str, message: str, listed: bool, tmp_path: Path
) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    path = str(tmp_path / images)
    config = {"scenes": {"s": {"images": path}}} if listed else {"images": path}
    with pytest.raises(ConfigError, match=message) as refused:
        Plan({"output": str(tmp_path / "out"), **config})
    sentence = str(refused.value)
    assert "\n" not in sentence and path in sentence
    if message.endswith(": "):
        # in a file that lists scenes, the key images is refused beside them
        assert ("--config images=PATH" in sentence) == (not listed)
        assert ("of scene 's'" in sentence and "correct its images: in the file" in sentence) == listed


def test_what_may_not_be_read_is_named() -> None:
    # where every user may enter and write, which TMPDIR need not be
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        assert len(plan_of(folder, cameras="K.txt").scenes) == 1
        (folder / "out").mkdir()
        (folder / "out").chmod(0o777)
        config = {key: str(folder / name) for key, name in (("images", "photos"), ("output", "out"))}
        config["cameras"] = str(folder / "K.txt")
        (folder / "K.txt").chmod(0)
        with without_root(), pytest.raises(ConfigError, match=r"K\.txt', .* cannot be read \(Permission"):
            Plan(config)
        folder.chmod(0)
        with without_root(), pytest.raises(ConfigError, match=r"output folder '.*out' cannot be written"):
            Plan(config)
        config["output"] = "/tmp"
        with without_root(), pytest.raises(ConfigError, match=r"photos'.* cannot be read: change its perm"):
            Plan(config)


@pytest.mark.parametrize("place", ["", "0", "sparse", "sparse/0"])
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_a_reference_may_lie_in_any_place(place: str, suffix: str, tmp_path: Path) -> None:
    folder = tmp_path / "there" / place
    folder.mkdir(parents=True)
    for part in MODEL:
        (folder / f"{part}{suffix}").write_bytes(b"")
    assert len(plan_of(tmp_path, reference="there").scenes) == 1
    (folder / f"points3D{suffix}").unlink()
    with pytest.raises(ConfigError, match="does not contain a COLMAP model"):
        plan_of(tmp_path, reference="there")


@pytest.mark.parametrize(("model", "count"), [(0, 3), (1, 4), (4, 8), (6, 12), (11, 16)])
def test_binary_cameras_of_any_model_are_taken(model: int, count: int, tmp_path: Path) -> None:
    camera = struct.pack(f"<IiQQ{count}d", 1, model, 640, 480, *[1.0] * count)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 2) + camera + camera)
    assert len(plan_of(tmp_path, cameras="cameras.bin").scenes) == 1


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{MATRIX}",
        f"# f in pixels\n\n {MATRIX}",
        f"\ufeff{CAMERAS}",
        # the job that reads it says that it has no cameras
        "# Camera list\n",
    ],
)
def test_text_of_cameras_may_begin_with_comments_and_a_mark(text: str, tmp_path: Path) -> None:
    (tmp_path / "mine.dat").write_text(text, "utf-8")
    assert len(plan_of(tmp_path, cameras="mine.dat").scenes) == 1
