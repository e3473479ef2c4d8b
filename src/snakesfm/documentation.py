"""Makes config.yaml, its JSON schema and the reference pages in docs/ from the code.

``python -m snakesfm.documentation`` rewrites them; a test fails where they differ from the code.
"""

import ast
import dataclasses
import functools
import inspect
import json
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from snakesfm.artifacts import ARTIFACTS
from snakesfm.config.configuration import (
    RunOptions,
    SceneInputs,
    configuration_class,
    options_class,
)
from snakesfm.pipeline import STAGES

WIDTH = 110
FILES = {
    "image_index": ("index_images/index.h5",),
    "local_features": ("extract_features/BLOCK.h5", "merge_keypoints/BLOCK.h5"),
    "vocabulary": ("learn_vocabulary/vocabulary.h5",),
    "global_descriptors": ("describe_images/BLOCK.h5",),
    "image_pairs": ("select_pairs/TILE.h5",),
    "pair_matches": ("match_pairs/TILE.h5", "index_matches/TILE.h5"),
    "pair_coordinates": ("match_pairs/TILE.h5",),
    "calibrated_cameras": ("calibrate_cameras/cameras.h5",),
    "two_view_geometries": ("estimate_two_view/TILE.h5",),
    "view_graph": ("build_view_graph/graph.h5", "filter_view_graph/graph.h5"),
    "camera_rotations": ("average_rotations/rotations.h5",),
    "tracks": ("build_tracks/tracks.h5",),
    "camera_centers": ("average_translations/centers.h5",),
    "triangulated_points": ("triangulate_tracks/points.h5",),
    "reconstruction": ("adjust_bundle/reconstruction.h5",),
}
"""Where the artifacts of a kind are, below OUTPUT/SCENE."""
JSON_FILES = """
## metrics.json and metrics.csv

`evaluate_model/metrics.json` is of the largest model; `metrics.csv` has its scalars as one row. Values that do not exist are
null, in the CSV file empty.

| key | meaning |
|---|---|
| `scene`, `images`, `registered_images`, `images_in_other_models` | name, images of the index, of the largest model, of all other models |
| `points`, `observations`, `observations_per_image` | number of points, of their observations, and of the latter per registered image |
| `track_length_mean`, `_median` | observations per point |
| `reprojection_error_px_mean`, `_median` | original pixels; the mean is over observations, the median over the points' means |

With a reference model there are also:

| key | meaning |
|---|---|
| `reference_images`, `reference_images_present`, `reference_images_registered` | images with a pose in the reference; how many of them this scene has, by their names; how many have a pose in the model. All following values are of the first; areas are null where the second is 0 |
| `relative_pose_auc_Tdeg` | area under the recall curve up to T degrees, in per cent, of the larger of the errors in rotation and in direction of translation, over all ordered pairs of images (a sample beyond 2,000 images); a pair with an image without a pose counts as 180 degrees |
| `relative_pairs` | number of these pairs |
| `relative_rotation_error_deg_S`, `relative_translation_angle_deg_S` | these errors over pairs of registered images; S is median, mean, p90 or max |
| `pose_auc_Tdeg` | the same area for the larger of the errors in rotation and in the angle between the position vectors from the origin, over all images after alignment by a similarity transform; an image without a pose counts as 180 degrees |
| `rotation_error_deg_S`, `translation_angle_deg_S`, `position_error_S` | these errors, and distances in units of the reference, of registered images after alignment |
| `position_error_percent_S` | the distances in per cent of `reference_extent` |
| `reference_extent`, `alignment_scale` | diagonal of the box around the reference's camera centres; scale of the alignment |
| `reference`, `per_image` | only in the JSON file: path of the reference, and per image, by its name in the model, `reference_name`, `rotation_error_deg`, `translation_angle_deg`, `position_error` |

## summary.json

`export_model/summary.json`:

| key | meaning |
|---|---|
| `scene`, `images`, `registered_images` | name, images of the index, images of the largest model |
| `images_in_other_models` | list: number of images of `sparse/1`, `sparse/2`, ... |
| `not_registered` | names of the images that are in no model |
| `points`, `observations`, `mean_track_length`, `mean_reprojection_error_px` | of the largest model, in original pixels |
| `warnings` | list of sentences |
| `georeference` | null, or the place of the largest model: `axes`, `origin_latitude_longitude_altitude` (degrees and metres, WGS84), `rotation_from_adjustment` (rows: east, north and up in the coordinate frame of `reconstruction.h5`), `images_with_position`, `inliers` (positions that agree with the model), `median_residual_m`, `median_horizontal_residual_m`, `median_vertical_residual_m`, `altitude_steps` |
| `georeference_refused` | why the largest model has no place, if images have GPS or `georeference` is true; else null, as with `georeference: false` |
| `georeference_of_models` | list: the same as `georeference` for each model |
"""


@functools.cache
def describe_options() -> None:
    """Give the fields of all models the sentences below them.

    pydantic would do it itself, but at each start of a job, which takes most of the time of making the models.
    """
    models: tuple[type[BaseModel], ...] = (SceneInputs, RunOptions, *map(options_class, STAGES))
    for cls in models:
        inherited = _sentences_below(SceneInputs) if issubclass(cls, SceneInputs) else {}
        for name, sentence in (inherited | _sentences_below(cls)).items():
            cls.model_fields[name].description = sentence
        cls.model_rebuild(force=True)
    whole = configuration_class()
    for name, field in RunOptions.model_fields.items():
        whole.model_fields[name].description = field.description
    whole.model_rebuild(force=True)


def _sentences_below(cls: type[BaseModel]) -> dict[str, str]:
    """The strings that stand below the fields of a class, by field."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in pairwise(definition.body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = inspect.cleandoc(text)
    return {name: text for name, text in found.items() if name in cls.model_fields}


def render_schema() -> str:
    """JSON schema of config.yaml, for editors."""
    describe_options()
    schema = configuration_class().model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "snakesfm configuration"
    return json.dumps(schema, indent=1, sort_keys=True) + "\n"


def render_config() -> str:
    """config.yaml: every option with its default and one sentence."""
    describe_options()
    lines = [
        "# yaml-language-server: $schema=workflow/schemas/config.schema.json",
        "# Every option of snakesfm with its default. Unchanged, this reconstructs the demo scene ('make demo').",
        "# Change options here, in a file of your own (--configfile FILE) or per run (--config KEY=VALUE).",
        "# Generated from the code by 'python -m snakesfm.documentation'.",
        "",
    ]
    for name, field in RunOptions.model_fields.items():
        lines += _yaml_option(name, field, "")
    for stage in STAGES:
        cls = options_class(stage)
        lines += ["", f"# {_sentence(cls)}"]
        if cls.model_fields:
            lines.append(f"{stage}:")
            for name, field in cls.model_fields.items():
                lines += _yaml_option(name, field, "  ")
        else:
            lines.append(f"{stage}: {{}}")
    return "\n".join(lines) + "\n"


def _sentence(cls: type) -> str:
    return " ".join((cls.__doc__ or "").strip().split("\n\n")[0].split())


def _yaml_option(name: str, field: FieldInfo, indent: str) -> list[str]:
    comment = textwrap.wrap(" ".join((field.description or "").split()), WIDTH - len(indent))
    default = field.get_default(call_default_factory=True)
    value = default.model_dump(mode="json") if isinstance(default, BaseModel) else default
    value = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump({name: value}, default_flow_style=True, allow_unicode=True, width=1000)
    return [f"{indent}# {line}" for line in comment] + [indent + text.strip()[1:-1]]


def render_configuration_page() -> str:
    """docs/configuration.md."""
    describe_options()
    lines = [
        "# Configuration",
        "",
        "Generated from the options models by `python -m snakesfm.documentation`; do not edit.",
        "",
        "Options are read from `config.yaml`, then from files given with `--configfile`, then from "
        "`--config KEY=VALUE`; give all of them behind one `--config` (a second one is refused), and all files "
        "behind one `--configfile`. Stage options nest: `--config 'extract_features={max_keypoints: 8000}'`. "
        "Unknown keys are refused. Threads, memory and partitions are not options; they are set in the profile.",
        "",
        "In the stages after matching, options in pixels (`_px`) refer to the images as the detector sees them, "
        "scaled down to `extract_features.max_shorter_side_px` (LoFTR: `match_pairs.longer_side_px`), so they need "
        "not be changed for larger photographs. Imported keypoints are assumed to come from images of that size: "
        "if it was another, set the option to it. Files hold original pixels.",
        "",
        "**Which options matter.** Most users need only `images`, `output`, `masks` and `cameras`; "
        "`extract_features.max_shorter_side_px` and `max_keypoints` (more points); `select_pairs.method` (order of "
        "names, GPS, own list); `index_images.camera_sharing` and `camera_model` (lens); "
        "`export_model.undistort` and `georeference`. The others are mostly for experiments.",
        "",
        "## The run",
        "",
        *_table(RunOptions),
        "",
        "### Each scene under `scenes`",
        "",
        *_table(SceneInputs),
    ]
    for stage in STAGES:
        cls = options_class(stage)
        lines += ["", f"## {stage}", "", _sentence(cls)]
        if cls.model_fields:
            lines += ["", *_table(cls)]
    return "\n".join(lines) + "\n"


def _table(cls: type[BaseModel]) -> list[str]:
    properties = cls.model_json_schema()["properties"]
    rows = ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    for name, field in cls.model_fields.items():
        default = (
            "required" if field.is_required() else _plain(field.get_default(call_default_factory=True))
        )
        meaning = " ".join((field.description or "").split())
        rows.append(f"| `{name}` | {default} | {_allowed(properties[name])} | {meaning} |")
    return rows


def _plain(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    return f"`{json.dumps(value)}`"


def _allowed(schema: dict[str, Any]) -> str:
    if "anyOf" in schema:
        return " or ".join(_allowed(part) for part in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    text = {"null": "nothing", "object": "mapping", "array": "list"}.get(
        schema.get("type", "object"), schema.get("type", "mapping")
    )
    signs = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    limits = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return " ".join([text, ", ".join(limits)]).strip()


def render_artifacts_page() -> str:
    """docs/artifacts.md."""
    lines = [
        "# Artifacts",
        "",
        "Generated from `src/snakesfm/artifacts` by `python -m snakesfm.documentation`; do not edit.",
        "",
        "Every stage up to `adjust_bundle` writes HDF5 files at `OUTPUT/SCENE/STAGE/FILE.h5`, one per job (`select_pairs`: one per tile in one job); a file is complete or absent. BLOCK is 0, 1, ...; TILE is 0-0, 0-1, ... "
        "The root attributes are `artifact` (the kind below), `format_version`, `stage`, `stage_version`, `scene`, "
        "`options`, `settings` (canonical JSON; `settings` holds the seed and other inputs that are not options), "
        "`software`, and `checksum` (CRC-32 of all datasets in the order of the table below; readers refuse a file "
        "with another one); the index also has `images`, the folder that it is of, which no job compares. There are "
        "no timestamps, so equal runs on one image folder give equal bytes. Readers refuse other kinds and versions.",
        "",
        "Letters in shapes are lengths: the same letter is the same length within one file, and `P+1` is one more "
        "than `P`. Items that belong to others (matches of a pair, keypoints of an image) are stored in flat tables "
        "with row offsets. Poses are named target_from_source: `cam_from_world` maps the world to the camera, "
        "`j_from_i` maps camera i to camera j. The centre of the top-left pixel is (0.5, 0.5).",
    ]
    for cls in ARTIFACTS:
        lines += [
            "",
            f"## {cls.kind} (version {cls.format_version})",
            "",
            _sentence(cls),
            "",
            f"Files: {', '.join(f'`{file}`' for file in FILES[cls.kind])}.",
            "",
            "| dataset | shape | dtype | meaning |",
            "|---|---|---|---|",
        ]
        for field in dataclasses.fields(cls):
            meta = field.metadata
            dtype = "UTF-8 string" if meta["dtype"] == "str" else meta["dtype"].replace("|", " or ")
            lines.append(f"| `{field.name}` | {meta['shape']} | {dtype} | {meta['description']} |")
    return "\n".join(lines) + "\n" + JSON_FILES


GENERATED = {
    "workflow/schemas/config.schema.json": render_schema,
    "config.yaml": render_config,
    "docs/configuration.md": render_configuration_page,
    "docs/artifacts.md": render_artifacts_page,
}


def main() -> None:
    """Rewrite all generated files below the current folder."""
    for name, render in GENERATED.items():
        Path(name).write_text(render(), "utf-8")


if __name__ == "__main__":
    main()
