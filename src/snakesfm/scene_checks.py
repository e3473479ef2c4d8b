"""Checks before a scene's first job: paths that do not exist, or whose files cannot be used."""

from pathlib import Path

from snakesfm.config.configuration import options_class
from snakesfm.errors import ConfigError
from snakesfm.given_files import (
    NO_CAMERAS,
    NO_CAMERAS_FILE,
    NO_MODEL,
    find_cameras_file,
    find_model_folder,
    looks_like_cameras,
)
from snakesfm.hloc_files import FEATURES, MATCHES
from snakesfm.ingest.discover import (
    count_images,
    list_photographs,
    list_videos,
    resolved_name,
    walk_images,
)
from snakesfm.ingest.masks import find_mask
from snakesfm.pipeline import STAGES
from snakesfm.scene_plan import ScenePlan

CORRECT = "correct its images: in the file that lists it"


def check_scene(scene: ScenePlan) -> None:
    """Refuse paths that do not exist, or whose files cannot be used.

    Raises
    ------
    ConfigError : names the path and the remedy.
    """
    try:
        _check_images(scene)
        _check_keys_together(scene)
        _check_given_files(scene)
        _check_cameras(scene)
        if scene.inputs.masks:
            _check_masks(scene)
    except PermissionError as error:
        raise ConfigError(
            f"'{error.filename}' of scene '{scene.name}' cannot be read: change its permissions or those "
            "of the folders that it is in."
        ) from None
    models = [model for stage in STAGES for model in scene.models(stage)]
    if len(models) > 1 and scene.weights.is_file():
        raise ConfigError(
            f"weights={scene.weights} is a single file, but scene '{scene.name}' needs the weights of "
            f"{len(models)} networks ({', '.join(models)}): give a folder that contains them all."
        )


def check_results(scene: ScenePlan) -> None:
    """Refuse to replace the results of another image folder that has the same name and is still there.

    Where the user named the scene, nothing is refused, so that images may come to lie elsewhere.

    Raises
    ------
    ConfigError : names the other folder and the remedy.
    """
    index = scene.folder / "index_images" / "index.h5"
    if scene.configuration.scene or scene.configuration.scenes or not index.is_file():
        return
    # loaded here, as jobs parse the Snakefile too and need not ask
    from snakesfm.artifacts.base import read_header

    former = str(read_header(index).get("images", ""))
    if former in ("", resolved_name(scene.images)) or not Path(former).is_dir():
        return
    if not Path(former).samefile(scene.images):
        raise ConfigError(
            f"'{scene.folder}' holds the results of '{former}': set scene=NAME or another output=DIR (or "
            f"scene={scene.name} to replace them)."
        )


def _check_images(scene: ScenePlan) -> None:
    images = scene.images
    if images.is_file():
        raise ConfigError(
            f"'{images}', given as images= for scene '{scene.name}', is a file: give the folder that "
            "contains the images (unpack an archive; extract a video's frames, e.g. with ffmpeg)."
        )
    listed = scene.name in scene.configuration.scenes
    if not images.is_dir() and listed:
        raise ConfigError(f"The image folder '{images}' of scene '{scene.name}' does not exist: {CORRECT}.")
    if not images.is_dir():
        hint = "make it with 'make demo', or " if scene.inputs.images == "demo/images" else ""
        raise ConfigError(
            f"The image folder '{images}' does not exist: {hint}choose the folder with "
            "--config images=PATH (if the path contains ' #', where Snakemake cuts it, set it in a file "
            "for --configfile)."
        )
    if scene.folder.resolve() == images.resolve():
        raise ConfigError(
            f"Scene '{scene.name}' would be written into its own image folder '{images}': choose another "
            "scene=NAME or output=DIR."
        )
    if scene.folder.resolve().is_relative_to(images.resolve()):
        raise ConfigError(
            f"The output folder '{scene.folder.parent}' is inside the image folder '{images}', so its "
            "pictures would be treated as photographs: choose another output=DIR."
        )
    if count_images(images, 1) == 0:
        whose = f" of scene '{scene.name}'" if listed else ""
        otherwise = CORRECT if listed else "choose another one with --config images=PATH"
        raise ConfigError(
            f"The folder '{images}'{whose} contains no JPEG, PNG, TIFF, WebP or BMP image: "
            f"{_find_images(images, otherwise)}."
        )


def _find_images(folder: Path, otherwise: str) -> str:
    """How a folder without images gets some from its files, or what is to be done otherwise."""
    _, unread = list_photographs(folder)
    if unread:
        return f"convert files such as '{unread[0]}' to JPEG ({len(unread)} files)"
    videos = list_videos(folder)
    if videos:
        return f"extract the frames of videos such as '{videos[0]}', e.g. with ffmpeg ({len(videos)} files)"
    return otherwise


def _check_keys_together(scene: ScenePlan) -> None:
    """Refuse keys that would do nothing beside the others, or lack one that they need."""
    inputs, front_end = scene.inputs, scene.configuration.front_end
    for stage in ("extract_features", "match_pairs") if front_end else ():
        chosen, implied = getattr(scene.configuration, stage).method, scene.method(stage)
        # config.yaml sets every option, so the default says nothing of what the user wants
        if chosen not in (implied, options_class(stage).model_fields["method"].default):
            raise ConfigError(
                f"front_end={front_end} means {stage}.method '{implied}', but the configuration sets "
                f"'{chosen}': remove front_end and set both extract_features.method and "
                f"match_pairs.method, or remove {stage}.method."
            )
    if inputs.imported and scene.method("extract_features") != "imported":
        raise ConfigError(
            f"Scene '{scene.name}' has imported={inputs.imported}, which is only read by the front-end "
            "'imported': set front_end=imported or remove imported=."
        )
    if inputs.pairs and scene.select_pairs.method != "listed":
        raise ConfigError(
            f"Scene '{scene.name}' has pairs={inputs.pairs}, but select_pairs.method "
            f"'{scene.select_pairs.method}' does not read it: set this to 'listed' or remove pairs=."
        )
    if inputs.intrinsics == "refine" and not inputs.cameras:
        raise ConfigError(
            f"Scene '{scene.name}' has intrinsics=refine, but no known intrinsics to refine (others are "
            "refined anyway): set cameras=PATH or remove intrinsics=."
        )
    if scene.configuration.select_pairs.method == "listed" and not scene.pairs_file:
        raise ConfigError(
            f"select_pairs.method is 'listed', but scene '{scene.name}' has no list of pairs: "
            "set pairs=FILE."
        )
    methods = (scene.method("extract_features"), scene.method("match_pairs"))
    oracle = next((name for name in methods if name in ("virtual", "virtual_places")), "")
    if oracle and not scene.inputs.reference:
        raise ConfigError(
            f"The front-end '{oracle}' needs the points of a reference model, but scene '{scene.name}' "
            "has none: set reference=PATH."
        )
    if scene.method("extract_features") == "imported" and not scene.inputs.imported:
        raise ConfigError(
            f"The front-end 'imported' reads hloc's files, but scene '{scene.name}' names none: "
            "set imported=DIR."
        )


def _check_given_files(scene: ScenePlan) -> None:
    for key in ("reference", "cameras", "masks", "pairs", "imported"):
        path = getattr(scene.inputs, key)
        if path and not Path(path).expanduser().exists():
            raise ConfigError(
                f"'{path}', given as {key}= for scene '{scene.name}', does not exist: "
                "correct the path or remove the key."
            )
    if scene.inputs.pairs and not Path(scene.inputs.pairs).expanduser().is_file():
        raise ConfigError(
            f"'{scene.inputs.pairs}', given as pairs= for scene '{scene.name}', is not a file: "
            "give a text file with two image names per line."
        )
    if scene.inputs.imported and not Path(scene.inputs.imported).expanduser().is_dir():
        raise ConfigError(
            f"'{scene.inputs.imported}', given as imported= for scene '{scene.name}', is not a folder: "
            f"give the folder that contains hloc's {FEATURES} and {MATCHES}."
        )
    reference = scene.inputs.reference
    if reference and find_model_folder(Path(reference).expanduser()) is None:
        raise ConfigError(f"'{reference}', given as reference= for scene '{scene.name}', {NO_MODEL}")


def _check_cameras(scene: ScenePlan) -> None:
    if not scene.inputs.cameras:
        return
    given = f"'{scene.inputs.cameras}', given as cameras= for scene '{scene.name}',"
    file = find_cameras_file(Path(scene.inputs.cameras).expanduser())
    if file is None:
        raise ConfigError(f"{given} {NO_CAMERAS_FILE}")
    try:
        fits = looks_like_cameras(file)
    except OSError as error:
        raise ConfigError(f"{given} cannot be read ({error.strerror}): change its permissions.") from None
    if not fits:
        raise ConfigError(f"{given} {NO_CAMERAS}: correct the path or remove the key.")


def _check_masks(scene: ScenePlan) -> None:
    masks = scene.masks
    if not masks.is_dir():
        raise ConfigError(
            f"'{masks}', given as masks=, is not a folder: give the folder that contains the masks."
        )
    if masks.resolve().is_relative_to(scene.images.resolve()):
        raise ConfigError(
            f"The folder of masks '{masks}' is inside the image folder '{scene.images}', so its files "
            "would be treated as photographs: move it elsewhere."
        )
    if scene.method("extract_features") == "imported" or scene.detector_free:
        raise ConfigError(
            f"Scene '{scene.name}' has masks, but these cannot be applied to matches that are imported or "
            "found without keypoints: remove masks= or use another front_end."
        )
    # every job comes by here: with a mask for each image, the first one is enough
    if not any(find_mask(masks, image) for image in walk_images(scene.images)):
        raise ConfigError(
            f"The folder of masks '{masks}' contains no mask for any image of scene '{scene.name}': name "
            "the mask of 'a/b.jpg' 'a/b.jpg.png' or 'a/b.png'."
        )
