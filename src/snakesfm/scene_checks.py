"""What is refused before a scene's first job: paths that are not there, or whose files do not serve."""

from pathlib import Path

from snakesfm.config.configuration import STAGES
from snakesfm.errors import ConfigError
from snakesfm.ingest.discover import count_images, list_photographs, walk_images
from snakesfm.ingest.masks import find_mask
from snakesfm.scene_plan import ScenePlan


def check_scene(scene: ScenePlan) -> None:
    """Refuse paths that are not there, or whose files do not serve.

    Raises
    ------
    ConfigError : says which and what to do.
    """
    _check_images(scene)
    _check_given_files(scene)
    if scene.inputs.masks:
        _check_masks(scene)
    models = [model for stage in STAGES for model in scene.models(stage)]
    if len(models) > 1 and scene.weights.is_file():
        raise ConfigError(
            f"weights={scene.weights} is one file, but scene '{scene.name}' needs those of "
            f"{len(models)} networks ({', '.join(models)}): give a folder that holds them all."
        )


def _check_images(scene: ScenePlan) -> None:
    images = scene.images
    if not images.is_dir():
        hint = "make it with 'make demo', or " if scene.inputs.images == "demo/images" else ""
        raise ConfigError(
            f"The image folder '{images}' does not exist: {hint}say which folder with "
            "--config images=PATH (name a path with ' #' in it in a file for --configfile: "
            "Snakemake cuts it there)."
        )
    if scene.folder.resolve() == images.resolve():
        raise ConfigError(
            f"Scene '{scene.name}' would be written into its own image folder '{images}': give it another "
            "scene=NAME or another output=DIR."
        )
    if scene.folder.resolve().is_relative_to(images.resolve()):
        raise ConfigError(
            f"The output folder '{scene.folder.parent}' lies inside the image folder '{images}', so its "
            "pictures would be taken for photographs: give another output=DIR."
        )
    if count_images(images, 1) == 0:
        _, unread = list_photographs(images)
        remedy = (
            f"convert those like '{unread[0]}' to JPEG ({len(unread)} in number)."
            if unread
            else "say with --config images=PATH which folder does."
        )
        raise ConfigError(f"The folder '{images}' holds no JPEG, PNG, TIFF, WebP or BMP image: {remedy}")


def _check_given_files(scene: ScenePlan) -> None:
    if scene.configuration.select_pairs.method == "listed" and not scene.pairs_file:
        raise ConfigError(
            f"select_pairs.method is 'listed', but scene '{scene.name}' has no list: "
            "give it with pairs=FILE."
        )
    methods = (scene.method("extract_features"), scene.method("match_pairs"))
    oracle = next((name for name in methods if name in ("virtual", "virtual_places")), "")
    if oracle and not scene.inputs.reference:
        raise ConfigError(
            f"The front-end '{oracle}' takes the points of a reference model, but scene '{scene.name}' "
            "has none: give reference=PATH."
        )
    if scene.method("extract_features") == "imported" and not scene.inputs.imported:
        raise ConfigError(
            f"The front-end 'imported' reads hloc's files, but scene '{scene.name}' names none: "
            "give imported=DIR."
        )
    for key in ("reference", "cameras", "masks", "pairs", "imported"):
        path = getattr(scene.inputs, key)
        if path and not Path(path).expanduser().exists():
            raise ConfigError(
                f"'{path}', given as {key}= for scene '{scene.name}', does not exist: "
                "correct the path or remove the key."
            )
    if scene.inputs.pairs and not Path(scene.inputs.pairs).expanduser().is_file():
        raise ConfigError(
            f"'{scene.inputs.pairs}', given as pairs= for scene '{scene.name}', is no file: "
            "name the text file with two image names per line."
        )
    if scene.inputs.imported and not Path(scene.inputs.imported).expanduser().is_dir():
        raise ConfigError(
            f"'{scene.inputs.imported}', given as imported= for scene '{scene.name}', is no folder: "
            "name the folder that holds hloc's features.h5 and matches.h5."
        )


def _check_masks(scene: ScenePlan) -> None:
    masks = scene.masks
    if not masks.is_dir():
        raise ConfigError(
            f"'{masks}', given as masks=, is no folder: give the folder that holds the masks."
        )
    if masks.resolve().is_relative_to(scene.images.resolve()):
        raise ConfigError(
            f"The folder of masks '{masks}' lies inside the image folder '{scene.images}', so its files "
            "would be taken for photographs: move it elsewhere."
        )
    if scene.method("extract_features") == "imported" or scene.detector_free:
        raise ConfigError(
            f"Scene '{scene.name}' has masks, but they do not reach matches that are imported or found "
            "without keypoints: remove masks= or take another front_end."
        )
    # every job comes by here: with a mask for each image, the first one is enough
    if not any(find_mask(masks, image) for image in walk_images(scene.images)):
        raise ConfigError(
            f"The folder of masks '{masks}' holds none for any image of scene '{scene.name}': the mask of "
            "'a/b.jpg' is 'a/b.jpg.png' or 'a/b.png' in it."
        )
