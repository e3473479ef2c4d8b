"""The whole configuration: what config.yaml and ``--config`` may contain."""

import datetime
import difflib
import functools
import importlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, create_model, model_validator
from pydantic_core import ErrorDetails

from snakesfm.config.base import Options, StageOptions
from snakesfm.errors import ConfigError
from snakesfm.pipeline import STAGES

# what may look like a number or a date and is a name all the same
TEXT_KEYS = (
    "images",
    "output",
    "scene",
    "reference",
    "cameras",
    "masks",
    "pairs",
    "imported",
    "weights",
)

# pydantic's types of errors, and what was expected in plain words
KINDS = {
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "text",
}

# what Snakemake replaces in a path
REPLACED = r"[{}]|<[a-z][a-z0-9_]*>"
# what common file systems allow
MOST_NAME_BYTES = 255
# of braces the codes: it is a wildcard's constraint as well, in which Snakemake takes no braces
SCENE_PATTERN = r"[^/.\x7b\x7d][^/\x7b\x7d]*"


def options_class(stage: str) -> type[StageOptions]:
    """The options model of a stage: ``match_pairs`` has ``MatchPairsOptions``."""
    module = importlib.import_module(f"snakesfm.config.{stage}")
    name = "".join(part.capitalize() for part in stage.split("_")) + "Options"
    cls: type[StageOptions] = getattr(module, name)
    return cls


class SceneInputs(Options):
    """Where one scene's images and what is known about them are found."""

    images: str
    """Folder of photographs, searched with all its subfolders."""
    reference: str = ""
    """Folder of a COLMAP model to evaluate against; empty for none."""
    cameras: str = ""
    """Known intrinsics: a COLMAP cameras.txt (or its folder) or a 3x3 K.txt; empty for none."""
    intrinsics: Literal["fixed", "refine"] = "fixed"
    """Whether bundle adjustment keeps known intrinsics fixed or refines them."""
    masks: str = ""
    """Folder of masks, black where no keypoints are wanted: 'a/b.jpg.png' or 'a/b.png' for 'a/b.jpg',
    in the orientation in which the image is stored; not inside the image folder; empty for none."""
    pairs: str = ""
    """Text file of image pairs, one 'name0 name1' per line, used instead of all others;
    select_pairs.method must be 'auto' or 'listed'; empty for none."""
    imported: str = ""
    """Folder with hloc's features.h5, matches.h5 and, optionally, pairs.txt, for the front-end
    'imported'."""


FrontEndName = Literal[
    "",
    "sift",
    "aliked+lightglue",
    "disk+lightglue",
    "xfeat+lighterglue",
    "superpoint+lightglue",
    "superpoint+superglue",
    "loftr",
    "virtual",
    "virtual_places",
    "imported",
]


class RunOptions(SceneInputs):
    """Options of the whole run, and the inputs of its scene where there is one."""

    images: str = "demo/images"
    """Folder of photographs, searched with all its subfolders; unused if `scenes` lists any."""
    output: str = "results"
    """Output folder; each scene gets a folder in it."""
    scene: str = ""
    """Name of the scene; empty uses the name of the image folder (or of its parent, if it is called
    'images')."""
    front_end: FrontEndName = ""
    """Detector and matcher by one name; empty uses the methods set in extract_features and match_pairs."""
    weights: str = "weights"
    """Folder (or one file) of network weights, filled by target 'fetch_weights'; jobs never download."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device for networks: 'auto' uses CUDA if available, 'cpu' never does, 'cuda' fails without it."""
    batch_size: Annotated[int, Field(ge=1, le=256)] | Literal["auto"] = "auto"
    """Number of images or pairs passed to a network at once; 'auto' is 1 on the CPU, 4 on CUDA."""
    scenes: dict[str, SceneInputs] = Field(default_factory=dict)
    """Several scenes: a mapping from name to images, cameras, masks and the other inputs of a scene."""
    seed: int = Field(default=0, ge=0)
    """Seed of the random draws; the same seed gives the same model (a large one but for rounding)."""
    blocks: Annotated[int, Field(ge=1, le=200)] | Literal["auto"] = "auto"
    """Number of blocks the images are split into; B blocks give B(B+1)/2 tiles of pairs, one job each.
    'auto' depends on the number of images."""

    @model_validator(mode="before")
    @classmethod
    def _accept_numbers(cls, values: Any) -> Any:
        # --config scene=2024 arrives as a number, 2024-05-01 in a file as a date
        if isinstance(values, dict):
            for key in TEXT_KEYS:
                if _is_number(values.get(key)) or isinstance(values.get(key), datetime.date):
                    values = {**values, key: str(values[key])}
            if values.get("scenes") is None and "scenes" in values:
                values = {**values, "scenes": {}}
            if isinstance(values.get("scenes"), dict):
                values = {**values, "scenes": {str(name): of for name, of in values["scenes"].items()}}
        return values


def check_spelling(values: Mapping[str, Any], arguments: Sequence[str]) -> None:
    """Refuse text that Snakemake took for a number: of ``images=100_0042`` nothing but 1000042 is left.

    Parameters
    ----------
    values : the configuration as Snakemake has it.
    arguments : its command line.

    Raises
    ------
    ConfigError : the number is spelled otherwise than what was typed.
    """
    for key in TEXT_KEYS:
        typed = [text.partition("=")[2] for text in arguments if text.startswith(f"{key}=")]
        if typed and _is_number(values.get(key)) and typed[-1] != str(values[key]):
            remedy = f"write {key}=./{typed[-1]}" if key != "scene" else "choose another name"
            raise ConfigError(f"Snakemake reads {key}={typed[-1]} as the number {values[key]}: {remedy}.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@functools.cache
def configuration_class() -> type[RunOptions]:
    """The model of the whole configuration: RunOptions and one block of options per stage."""
    fields: dict[str, Any] = {
        stage: (cls := options_class(stage), Field(default=cls(), description=_first_line(cls)))
        for stage in STAGES
    }
    return create_model("Configuration", __base__=RunOptions, **fields)


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().splitlines()[0]


def load_configuration(values: Mapping[str, Any]) -> RunOptions:
    """Check a configuration.

    Raises
    ------
    ConfigError : an unknown key (the nearest known one is named) or a value out of bounds.
    """
    cls = configuration_class()
    try:
        return cls(**dict(values))
    except ValidationError as error:
        raise ConfigError(_one_sentence(cls, error)) from None


def _one_sentence(cls: type[BaseModel], error: ValidationError) -> str:
    """The first problem in one sentence that names the key and the remedy."""
    errors = error.errors()
    first = errors[0]
    path = _path_of(first)
    if first["type"] == "missing":
        # a key that is spelled wrongly says more than the one that is missing by that
        slips = (other for other in errors if other["type"] == "extra_forbidden")
        first = next((other for other in slips if other["loc"][:-1] == first["loc"][:-1]), first)
        path = _path_of(first)
    key = ".".join(path)
    if first["type"] == "extra_forbidden":
        written, _, value = path[-1].partition(":")
        if value:
            return f"Configuration key '{key}' contains a colon: write '{written}: {value}', with a space."
        known = _keys_beside(cls, path)
        elsewhere = [
            f"{stage}.{path[-1]}" for stage in STAGES if path[-1] in options_class(stage).model_fields
        ]
        nearest = elsewhere or difflib.get_close_matches(path[-1], known, n=1, cutoff=0.5)
        hint = f"did you mean '{nearest[0]}'" if nearest else f"the known keys are {', '.join(known)}"
        return f"Unknown configuration key '{key}': {hint}?" if nearest else f"Unknown key '{key}': {hint}."
    if first["type"] == "missing":
        return f"Configuration key '{key}' is missing: set it."
    if first["type"] in ("model_type", "dict_type"):
        return _refused_block(key, first["input"], [_path_of(other)[-1] for other in errors[1:]])
    if first["input"] is None:
        return f"Configuration key '{key}' has no value: set one or remove the key."
    # an option of several types has an error for each
    same = [other for other in errors if _path_of(other) == path]
    kinds = [other for other in same if other["type"] != "literal_error"]
    words = [f" (or {other['ctx']['expected']})" for other in same if other not in kinds and kinds]
    first = (kinds or same)[0]
    message = first["msg"].removeprefix("Value error, ")
    message = re.sub(r"^Input", "the value", message)
    message = message[:1].lower() + message[1:]
    if first["type"] in KINDS:
        message = f"the value should be {KINDS[first['type']]}"
    elif first["type"] == "tuple_type":
        example = list(options_class(path[0]).model_fields[path[1]].default)
        message = f"the value should be a list such as {example}"
    # a check of several options together is handed the whole block
    together = first["type"] == "value_error" and isinstance(first["input"], dict)
    given = "" if together else f" = {_as_written(first['input'])}"
    return f"Configuration key '{key}'{given}: {message}{''.join(words)}."


def _path_of(error: ErrorDetails) -> list[str]:
    """The keys that lead to the option that an error is about."""
    path = [str(part) for part in error["loc"] if not str(part).startswith("function-")]
    # what follows the option's name is pydantic's name of one of several types
    return path[: {"scenes": 3}.get(path[0], 2 if path[0] in STAGES else 1)]


def _as_written(value: Any) -> str:
    """A value as YAML has it where Python writes it otherwise."""
    if isinstance(value, list):
        return f"[{', '.join(map(_as_written, value))}]"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _refused_block(key: str, value: Any, others: Sequence[str]) -> str:
    """What is said where a block of keys was expected, and of those that stand beside it instead."""
    given = "has no value" if value is None else f"= {_as_written(value)}"
    known = options_class(key).model_fields if key in STAGES else SceneInputs.model_fields
    stray = [name for name in others if key != "scenes" and name in known]
    what = "one block of keys per scene" if key == "scenes" else "a block of options"
    remedy = f", such as '{stray[0]}', which stands beside it" if stray else " or in braces"
    if isinstance(value, str) and value.partition(":")[0] in known:
        remedy += ", with a space after each colon"
    return f"Configuration key '{key}' {given}: it should hold {what}, indented below it{remedy}."


def _keys_beside(cls: type[BaseModel], path: list[str]) -> list[str]:
    """The keys that are known where an unknown one was found."""
    if path[0] == "scenes":
        return list(SceneInputs.model_fields)
    if len(path) > 1:
        return list(options_class(path[0]).model_fields)
    return list(cls.model_fields)


def scene_name(images: str) -> str:
    """The name of a scene: its folder's as given, or its parent's where the folder is called 'images'."""
    folder = Path(os.path.abspath(Path(images).expanduser()))  # noqa: PTH100 - resolve() follows links
    return folder.parent.name if folder.name.lower() == "images" else folder.name


def _refuse_beside_scenes(configuration: RunOptions) -> None:
    for key in (*SceneInputs.model_fields, "scene"):
        if getattr(configuration, key) == RunOptions.model_fields[key].default:
            continue
        if key in ("images", "scene"):
            raise ConfigError(f"Set either '{key}' or 'scenes', not both: remove one of the two keys.")
        raise ConfigError(
            f"'{key}' next to 'scenes' applies to none of them: move it into each scene that needs it."
        )


def list_scenes(configuration: RunOptions) -> dict[str, SceneInputs]:
    """The scenes of a run, by name.

    Raises
    ------
    ConfigError : a name that cannot be a folder's.
    """
    scenes = dict(configuration.scenes)
    if not scenes:
        inputs = {key: getattr(configuration, key) for key in SceneInputs.model_fields}
        scenes = {configuration.scene or scene_name(configuration.images): SceneInputs(**inputs)}
    else:
        _refuse_beside_scenes(configuration)
    if re.search(REPLACED, configuration.output):
        raise ConfigError(
            f"The output folder '{configuration.output}' contains braces or a word in <>, which Snakemake "
            "would replace: choose another with output=DIR."
        )
    for name in scenes:
        if not re.fullmatch(SCENE_PATTERN, name) or re.search(REPLACED, name):
            raise ConfigError(
                f"'{name}' cannot be the name of a scene: set scene=NAME to a name without '/', braces or "
                "words in <> that does not start with a dot."
            )
        if len(os.fsencode(name)) > MOST_NAME_BYTES:
            raise ConfigError(
                f"The name of scene '{name[:40]}...' is longer than a folder's may be ({MOST_NAME_BYTES} "
                "bytes): choose a shorter one with scene=NAME."
            )
    return scenes
