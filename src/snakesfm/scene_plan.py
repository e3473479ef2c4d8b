"""The plan of one scene for the Snakefile: its blocks, tiles, files, and the parameters of its jobs.

Everything here is computed from the configuration and the listing of the image folder, so the graph of
jobs is known before anything runs.
"""

import functools
import json
from collections.abc import Iterable, Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

from snakesfm.blocks import choose_blocks, tile_names
from snakesfm.config.base import StageOptions
from snakesfm.config.configuration import SceneInputs, options_class
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.digests import file_digest, file_state, model_digest, settings_text
from snakesfm.front_ends import (
    DETECTOR_FREE,
    FRONT_ENDS,
    LEARNED_DESCRIPTORS,
    check_methods,
    fetch_command,
    needed_weights,
)
from snakesfm.geometry.detector_sides import LONGER_SIDE, SHORTER_SIDE
from snakesfm.hloc_files import FEATURES, MATCHES, PAIRS
from snakesfm.ingest.discover import DIGESTS_NAME, MASK_DIGESTS_NAME, count_images, fingerprint_images
from snakesfm.model_files import MODEL_FILES
from snakesfm.pair_lists import estimate_pair_count, find_pair_list, pair_list_state
from snakesfm.pipeline import STAGES, stages_between
from snakesfm.resources import Load, job_load

SCENE_ARTIFACTS = (
    "index_images/index.h5",
    "calibrate_cameras/cameras.h5",
    "build_view_graph/graph.h5",
    "filter_view_graph/graph.h5",
    "average_rotations/rotations.h5",
    "build_tracks/tracks.h5",
    "average_translations/centers.h5",
    "triangulate_tracks/points.h5",
    "adjust_bundle/reconstruction.h5",
)

STAGES_IN_DETECTOR_PIXELS = (
    "merge_keypoints",
    "index_matches",
    "calibrate_cameras",
    "estimate_two_view",
    "build_tracks",
    "triangulate_tracks",
    "adjust_bundle",
)
PROVISIONAL_STAGES = stages_between("estimate_two_view", "adjust_bundle")
IMAGE_LISTS = ("images.txt", "images.bin")
"""Beside known cameras: which image is of which."""
STAGES_WITH_NETWORKS = ("extract_features", "describe_images", "match_pairs")


class ScenePlan:
    """One scene's blocks, tiles and what its stages are told."""

    def __init__(self, name: str, inputs: SceneInputs, configuration: Any, output: Path) -> None:
        self.name = name
        self.inputs = inputs
        self.configuration = configuration
        self.folder = output / name
        check_methods(self.method("extract_features"), self.method("match_pairs"))

    def method(self, stage: str) -> str:
        """The method of a stage, by the front-end's name where one is given."""
        front_end = FRONT_ENDS.get(self.configuration.front_end)
        if front_end is None or stage not in ("extract_features", "match_pairs"):
            return str(getattr(getattr(self.configuration, stage), "method", ""))
        return front_end.detector if stage == "extract_features" else front_end.matcher

    @property
    def images(self) -> Path:
        """The image folder."""
        return Path(self.inputs.images).expanduser()

    @property
    def masks(self) -> Path:
        """The folder of masks, where one is given."""
        return Path(self.inputs.masks).expanduser()

    @functools.cached_property
    def image_count(self) -> int:
        """Number of files that look like images."""
        return count_images(self.images, None)

    @functools.cached_property
    def blocks(self) -> int:
        """Number of blocks."""
        blocks = self.configuration.blocks
        return choose_blocks(self.image_count) if blocks == "auto" else int(blocks)

    @functools.cached_property
    def select_pairs(self) -> SelectPairsOptions:
        """How pairs are chosen, with 'auto' resolved."""
        options: SelectPairsOptions = self.configuration.select_pairs
        detector = "" if self.detector_free else self.method("extract_features")
        return options.resolve(self.image_count, self.pairs_file, detector)

    @property
    def pairs_file(self) -> str:
        """The list of pairs that is given, or comes with imported matches, or these; "" for none."""
        if not self.inputs.pairs and self.method("match_pairs") == "imported":
            return find_pair_list(Path(self.inputs.imported).expanduser())
        return self.inputs.pairs

    def options(self, stage: str) -> StageOptions:
        """The options of a stage in this scene."""
        if stage == "select_pairs":
            return self.select_pairs
        options: StageOptions = getattr(self.configuration, stage)
        if stage in ("extract_features", "match_pairs"):
            options = options.model_copy(update={"method": self.method(stage)})
        if stage == "adjust_bundle" and self.method("extract_features") == "virtual":
            # what the images show is less exact than the projections of the model's points
            return options.model_copy(update={"refine_keypoints": False})
        return options.resolved()

    def models(self, stage: str) -> list[str]:
        """The networks whose weights a stage reads."""
        if stage == "describe_images" and not self.select_pairs.needs_descriptors:
            return []
        if stage == "extract_features" and not self.detects_keypoints:
            return []
        return self.possible_models(stage)

    def possible_models(self, stage: str) -> list[str]:
        """The networks whose weights a stage reads if it runs at all."""
        return needed_weights(stage, self.method(stage), self.method("extract_features"))

    @property
    def detects_keypoints(self) -> bool:
        """Whether extract_features runs: for the matching, or for the choice of pairs."""
        by_keypoints = self.select_pairs.needs_descriptors and not self.describes_pictures
        return not self.detector_free or by_keypoints

    @property
    def weights(self) -> Path:
        """The weights folder."""
        return Path(self.configuration.weights).expanduser()

    def gpus(self, stage: str) -> int:
        """How many GPUs a job of a stage makes use of."""
        return 1 if self.models(stage) and self.configuration.device != "cpu" else 0

    def source_settings(self, stage: str) -> dict[str, Any]:
        """What a stage is told of where known keypoints or matches are; nothing where it finds them."""
        method = self.method(stage)
        if method == "virtual_places" or (method == "virtual" and stage == "extract_features"):
            reference = str(Path(self.inputs.reference).expanduser())
            return {"reference": reference, "source_content": model_digest(reference)}
        if method == "imported":
            folder = Path(self.inputs.imported).expanduser()
            name = FEATURES if stage == "extract_features" else MATCHES
            return {"imported": str(folder), "source_content": file_state(folder / name)}
        return {}

    def mask_settings(self, main_process: bool) -> dict[str, Any]:
        """What a stage is told of the masks; nothing where there are none."""
        if not self.inputs.masks:
            return {}
        # as with images, only the controller reads them to see whether they changed
        content = self._mask_fingerprint if main_process else ""
        return {"masked": True, "masks": str(self.masks), "masks_content": content}

    def weight_settings(self, stage: str, main_process: bool) -> dict[str, Any]:
        """What a stage is told of its networks' weights; nothing where it has none."""
        models = self.models(stage)
        if not models:
            return {}
        methods = {name: self.method(name) for name in STAGES_WITH_NETWORKS}
        return {
            "weights": str(self.weights),
            "models": models,
            "weights_content": self._weights_contents[stage] if main_process else "",
            "fetch": fetch_command(self.configuration.front_end, methods, str(self.weights)),
            "device": self.configuration.device,
        }

    def files(self, stage: str, parts: str) -> list[str]:
        """All files of a stage that works on 'blocks' or on 'tiles'."""
        names = tile_names(self.blocks) if parts == "tiles" else map(str, range(self.blocks))
        return [self.file(stage, name) for name in names]

    def file(self, stage: str, name: str) -> str:
        """One artifact of a stage."""
        return str(self.folder / stage / f"{name}.h5")

    @property
    def detector_free(self) -> bool:
        """Whether pairs are matched without keypoints, which are then merged from the matches."""
        return self.method("match_pairs") in DETECTOR_FREE

    @property
    def detector_pixels(self) -> dict[str, int]:
        """To which size images are scaled down for the detector; nothing where points are projected."""
        finder = self.method("match_pairs" if self.detector_free else "extract_features")
        if finder.startswith("virtual"):
            return {}
        if self.detector_free:
            return {LONGER_SIDE: self.configuration.match_pairs.longer_side_px}
        return {SHORTER_SIDE: self.configuration.extract_features.max_shorter_side_px}

    @property
    def features_stage(self) -> str:
        """The stage whose keypoints the stages after matching read."""
        return "merge_keypoints" if self.detector_free else "extract_features"

    @property
    def matches_stage(self) -> str:
        """The stage whose matches the stages after matching read."""
        return "index_matches" if self.detector_free else "match_pairs"

    @property
    def describes_pictures(self) -> bool:
        """Whether a network describes the images themselves, instead of their local descriptors."""
        return self.method("describe_images") in LEARNED_DESCRIPTORS

    def vocabulary(self) -> list[str]:
        """The codebook of local descriptors where they describe the images, else nothing."""
        return [] if self.describes_pictures else [self.file("learn_vocabulary", "vocabulary")]

    @functools.cached_property
    def proposed_pair_count(self) -> int:
        """Most pairs that the method of select_pairs proposes, as far as is known before anything runs."""
        follows = self.select_pairs.method == "listed"
        listed = estimate_pair_count(self.pairs_file) if follows else 0
        return self.select_pairs.count_proposed(self.image_count, listed)

    @property
    def pair_count(self) -> int:
        """Most pairs that will be matched, as far as is known before anything runs."""
        return self.select_pairs.count_chosen(self.image_count, self.proposed_pair_count)

    @property
    def undistorts(self) -> bool:
        """Whether export_model works on the images themselves."""
        return bool(self.configuration.export_model.undistort)

    def load(self, stage: str, threads: int = 1) -> Load:
        """What one job of a stage works on with so many threads, on average over the blocks or tiles."""
        networks = len(self.models(stage))
        # a CUDA device holds its batches in memory of its own
        wanted = 1 if self.configuration.device == "cuda" else self.configuration.batch_size
        batch = 1 if wanted == "auto" else wanted
        pairs = self.proposed_pair_count if stage == "select_pairs" else self.pair_count
        of = self.configuration.extract_features
        size = of.max_shorter_side_px, of.max_keypoints
        load = job_load(stage, self.image_count, self.blocks, pairs, networks, batch, *size)
        return replace(load, undistorting=threads) if stage == "export_model" and self.undistorts else load

    def final_files(self) -> list[str]:
        """What a person looks at: the scene's model, its metrics and its report."""
        # a lost file is made again only if it is asked for
        names = [f"export_model/{name}" for name in MODEL_FILES]
        names += ["evaluate_model/metrics.json", "evaluate_model/metrics.csv", "render_report/index.html"]
        return [str(self.folder / name) for name in names]

    def database_file(self) -> str:
        """The COLMAP database of features and two-view geometries, which only its own target makes."""
        return str(self.folder / "export_database" / "database.db")

    def hloc_files(self) -> list[str]:
        """Features and matches in hloc's files, which only their own target makes."""
        return [str(self.folder / "export_hloc" / name) for name in (FEATURES, MATCHES, PAIRS)]

    def results(self, asked: Set[str]) -> list[str]:
        """What a run makes for others that does not say of itself how it was made.

        Parameters
        ----------
        asked : the words of Snakemake's command line, targets among them.
        """
        databases, hloc = "databases" in asked, "hloc" in asked
        files = [self.database_file()] if databases else []
        files += self.hloc_files() if hloc else []
        return files + (self.final_files() if "all" in asked or not (databases or hloc) else [])

    def all_files(self) -> list[str]:
        """What a run makes of the scene; Snakemake re-makes a lost file only if it is asked for by name."""
        return self.artifacts() + self.final_files()

    def artifacts(self) -> list[str]:
        """The artifacts of all stages."""
        files = [str(self.folder / name) for name in SCENE_ARTIFACTS]
        if self.detects_keypoints:
            files += self.files("extract_features", "blocks")
        if self.detector_free:
            files += self.files("merge_keypoints", "blocks")
        for stage in dict.fromkeys(
            ("select_pairs", "match_pairs", self.matches_stage, "estimate_two_view")
        ):
            files += self.files(stage, "tiles")
        if self.select_pairs.needs_descriptors:
            files += [*self.vocabulary(), *self.files("describe_images", "blocks")]
        return files

    @functools.cached_property
    def _weights_contents(self) -> dict[str, str]:
        """A digest of each stage's weights, whose files are too large to be read once per job."""
        # imported here, as most runs have no networks and every job parses the Snakefile
        from snakesfm.learned.weights import weights_digest

        return {stage: weights_digest(self.models(stage), self.weights) for stage in STAGES_WITH_NETWORKS}

    @functools.cached_property
    def _fingerprint(self) -> str:
        return fingerprint_images(self.images, self.folder / "index_images" / DIGESTS_NAME)

    @functools.cached_property
    def _mask_fingerprint(self) -> str:
        return fingerprint_images(self.masks, self.folder / "index_images" / MASK_DIGESTS_NAME)

    def settings(self, stage: str, wildcards: Mapping[str, str], main_process: bool) -> dict[str, Any]:
        """What a stage is told beside its options."""
        pixels = self.detector_pixels if stage in STAGES_IN_DETECTOR_PIXELS else {}
        return self._own_settings(stage, wildcards, main_process) | pixels

    def _own_settings(self, stage: str, wildcards: Mapping[str, str], main_process: bool) -> dict[str, Any]:
        inputs = self.inputs
        if stage == "index_images":
            # only the controller compares params, so only it reads the images to see whether they changed
            content = self._fingerprint if main_process else ""
            return {
                "images": str(self.images),
                "cameras": inputs.cameras,
                "cameras_content": file_digest(inputs.cameras, *IMAGE_LISTS),
                "blocks": self.blocks,
                "content": content,
            }
        if stage == "extract_features":
            settings = {"images": str(self.images), "block": int(wildcards["block"])}
            settings |= self.mask_settings(main_process)
            return settings | self.weight_settings(stage, main_process) | self.source_settings(stage)
        if stage == "match_pairs":
            known = self.weight_settings(stage, main_process) | self.source_settings(stage)
            if self.detector_free:
                return {"images": str(self.images)} | known
            return {"detector": self.method("extract_features")} | known
        if stage == "describe_images" and self.describes_pictures:
            block = {"images": str(self.images), "block": int(wildcards["block"])}
            return block | self.weight_settings(stage, main_process)
        if stage == "merge_keypoints":
            return {"images": str(self.images), "block": int(wildcards["block"])}
        if stage == "select_pairs":
            return {
                "blocks": self.blocks,
                "pairs_file": self.pairs_file,
                "pairs_content": pair_list_state(self.pairs_file),
            }
        if stage == "calibrate_cameras":
            # what makes its provisional model
            digests = {name: options_class(name)().digest() for name in PROVISIONAL_STAGES}
            distorts = self.configuration.adjust_bundle.refine_distortion
            return {"provisional": digests, "refine_distortion": distorts}
        if stage == "average_translations":
            return {"min_component_images": self.configuration.average_rotations.min_component_images}
        if stage == "adjust_bundle":
            model = self.configuration.index_images.camera_model
            return {"images": str(self.images), "intrinsics": inputs.intrinsics, "camera_model": model}
        if stage == "export_model":
            masks = {"masks": str(self.masks)} if inputs.masks else {}
            # the model's folder links to what the image folder is, which may be a link that is turned
            links = {"images": str(self.images), "images_target": str(self.images.resolve())}
            return links | {"intrinsics": inputs.intrinsics} | masks
        if stage == "evaluate_model":
            return {"reference": inputs.reference, "reference_content": model_digest(inputs.reference)}
        return {}

    def params(self, stage: str, wildcards: Mapping[str, str], main_process: bool) -> str:
        """All that determines a job's result beside its input files, as one canonical JSON string."""
        options = self.options(stage)
        content = {
            "options": json.loads(options.canonical_json()),
            "stage_version": options.stage_version,
            "settings": self.settings(stage, wildcards, main_process),
            "seed": self.configuration.seed,
        }
        return json.dumps(content, sort_keys=True)

    def settings_text(self, stage: str, path: Path) -> str:
        """What a stage's file says of its seed and settings if it was made as this plan has it."""
        parts = {"block": path.stem, "tile": path.stem}
        return settings_text(self.settings(stage, parts, True), self.configuration.seed)

    def upstream(self, inputs: Iterable[str]) -> dict[str, str]:
        """The options digest of every stage that made one of these files; a job checks them against it."""
        stages = {part for path in inputs for part in Path(path).parent.parts[-3:] if part in STAGES}
        return {stage: self.options_digests[stage] for stage in sorted(stages)}

    @functools.cached_property
    def options_digests(self) -> dict[str, str]:
        """Digest of every stage's version and options."""
        return {stage: self.options(stage).digest() for stage in STAGES}
