"""``python -m snakesfm.simulate FOLDER`` makes a large scene of known truth without rendering images.

FOLDER gets images/ (empty files that only name the images), reference/ (the true cameras as a COLMAP
model), config.yaml, results/SCENE/ with the artifacts of the first stages, and truth/ with the landmark
that every keypoint shows. ``snakemake --profile profiles/local --configfile
FOLDER/config.yaml`` goes on from there.
"""

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.base import Header
from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.pairs import REJECTIONS, ImagePairs, PairMatches, TwoViewGeometries
from snakesfm.atomic import atomic_path
from snakesfm.blocks import choose_blocks, deal_blocks, tile_names
from snakesfm.config.configuration import options_class
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.errors import ConfigError, SnakesfmError
from snakesfm.geometry.camera import Camera, cameras_to_columns
from snakesfm.geometry.colmap_checks import check_binary
from snakesfm.geometry.poses import translation_of
from snakesfm.grouping import offsets_of
from snakesfm.seeding import derive_seed
from snakesfm.synthetic.pairing import candidate_pairs, choose_partners, simulate_edge
from snakesfm.synthetic.sightings import DetectorModel, DistinctLooks, match_looks, sight
from snakesfm.synthetic.simulation_options import UNTIL, SimulationOptions, parse_arguments
from snakesfm.synthetic.surveys import SURVEYS, Survey

# per image the landmark ids of its keypoints, and those keypoints that can be matched
Truths = dict[int, tuple[Array, DistinctLooks]]

RECALL = 0.65


class Simulation:
    """Writes one scene. No more than two blocks of it are held at a time.

    Raises
    ------
    ConfigError : the folder is not empty.
    """

    def __init__(self, folder: Path, options: SimulationOptions) -> None:
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(f"{folder} is not empty: choose a new folder.")
        self.folder = folder.resolve()
        self.options = options
        self.scene = self.folder.name
        self.survey: Survey = SURVEYS[options.survey](options.images, options.seed)
        self.model = DetectorModel(max_keypoints=options.keypoints)
        self.blocks = options.blocks or choose_blocks(options.images)
        self.block_of = np.array(deal_blocks(self.survey.names, self.blocks))

    def run(self) -> None:
        """Make all artifacts up to the stage ``until``."""
        last = UNTIL.index(self.options.until)
        self.write_inputs()
        self.write_index()
        for block in range(self.blocks):
            self.write_features(block)
        if last >= 1:
            chosen = self.choose_pairs()
            for tile, pairs in self._tiles(chosen):
                self.write_pairs(tile, pairs)
            self.write_pair_list(chosen)
            if last >= 2:
                for tile, pairs in self._tiles(chosen):
                    self.write_matches(tile, pairs)
            if last >= 3:
                self.write_cameras()
                for tile, pairs in self._tiles(chosen):
                    self.write_geometries(tile, pairs)
        # the list of what there is comes last: without it nothing can be started
        self.write_config(listed=last >= 1)

    def write_inputs(self) -> None:
        """Files that stand for the images, and the reference model."""
        from snakesfm.export.colmap import build_reconstruction

        for name in self.survey.names:
            path = self.folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        rotations, count = self.survey.rotations, len(self.survey.names)
        model = build_reconstruction(
            self.survey.names,
            np.zeros(count, np.int32),
            [self.survey.camera],
            rotations,
            translation_of(rotations, self.survey.centers),
            np.zeros((0, 3)),
            np.zeros((0, 3), np.uint8),
            np.zeros(0),
            np.zeros(1, np.int64),
            np.zeros(0, np.int32),
            np.zeros((0, 2)),
        )
        (self.folder / "reference").mkdir()
        model.write_binary(str(self.folder / "reference"))
        check_binary(self.folder / "reference", model)

    @property
    def camera(self) -> Camera:
        """The camera as the workflow is told it."""
        true = self.survey.camera
        if self.options.known_focal:
            return true
        guess = options_class("index_images")().default_focal_ratio * max(true.width, true.height)  # type: ignore[attr-defined]
        return Camera(
            "SIMPLE_RADIAL", true.width, true.height, (guess, *true.params[2:4], 0.0), source="default"
        )

    def write_index(self) -> None:
        """The artifact of index_images."""
        names = np.array(self.survey.names, dtype=object)
        count = len(names)
        models, sizes, params, sources = cameras_to_columns([self.camera])
        ImageIndex(
            names=names,
            sizes=np.tile(sizes, (count, 1)),
            sha256=np.array([self._digest("image", str(name)) for name in names], dtype=object),
            blocks=self.block_of,
            camera_ids=np.zeros(count, np.int32),
            orientations=np.ones(count, np.int32),
            focal_exif_px=np.full(count, np.nan),
            gps=np.full((count, 3), np.nan),
            duplicate_of=np.full(count, -1, np.int32),
            camera_models=np.array(models, dtype=object),
            camera_sizes=sizes,
            camera_params=params,
            camera_sources=np.array(sources, dtype=object),
            refused_names=np.zeros(0, dtype=object),
            refused_reasons=np.zeros(0, dtype=object),
            warnings=np.zeros(0, dtype=object),
        ).write(self._path("index_images", "index"), self._header("index_images"))

    def write_features(self, block: int) -> None:
        """The artifact of extract_features for one block, and its truth."""
        images = np.flatnonzero(self.block_of == block)
        described = UNTIL.index(self.options.until) < 2
        sightings = [
            sight(self.survey, image, self.options.seed, self.model, described) for image in images.tolist()
        ]
        names = [self.survey.names[image] for image in images]
        offsets = offsets_of([len(s.landmarks) for s in sightings])
        size = 128 if described else 0
        LocalFeatures(
            image_ids=images,
            names=np.array(names, dtype=object),
            digests=np.array([self._digest("features", name) for name in names], dtype=object),
            sizes=np.tile([self.survey.camera.width, self.survey.camera.height], (len(images), 1)),
            offsets=offsets,
            keypoints=_join([s.keypoints.keypoints for s in sightings], (0, 2), "float32"),
            descriptors=_join([s.keypoints.descriptors for s in sightings], (0, size), "uint8"),
            scores=_join([s.keypoints.scores for s in sightings], (0,), "float32"),
            scales=_join([s.keypoints.scales for s in sightings], (0,), "float32"),
            angles=_join([s.keypoints.angles for s in sightings], (0,), "float32"),
            colors=_join([s.colors for s in sightings], (0, 3), "uint8"),
        ).write(self._path("extract_features", str(block)), self._header("extract_features"))
        path = self.folder / "truth" / f"{block}.npz"
        path.parent.mkdir(exist_ok=True)
        distinct = [DistinctLooks.of(s.appearance) for s in sightings]
        np.savez(
            path,
            image_ids=images,
            offsets=offsets,
            landmarks=_join([s.landmarks for s in sightings], (0,), "int64"),
            distinct=offsets_of([len(d.looks) for d in distinct]),
            looks=_join([d.looks for d in distinct], (0,), "uint64"),
            rows=_join([d.rows for d in distinct], (0,), "int64"),
        )

    def choose_pairs(self) -> Array:
        """Pairs (S,2), sorted: of each image those most alike, and one that only looks alike."""
        pairs, near = candidate_pairs(self.survey, self.options.seed)
        alike = np.zeros(len(pairs), np.int32)
        for tile, rows in self._rows_of_tiles(pairs):
            truths = self._truths(tile)
            for row in rows.tolist():
                alike[row] = len(self._matches(truths, *pairs[row].tolist()))
        return pairs[choose_partners(pairs, near, alike, len(self.survey.names), self.options.partners)]

    def write_pairs(self, tile: str, pairs: Array) -> None:
        """The artifact of select_pairs for one tile."""
        ImagePairs(
            pairs=pairs,
            reasons=np.full(len(pairs), "listed", dtype=object),
            similarities=np.full(len(pairs), np.nan, np.float32),
            likenesses=np.full(len(pairs), np.nan, np.float32),
        ).write(self._path("select_pairs", tile), self._header("select_pairs"))

    def write_pair_list(self, pairs: Array) -> None:
        """The pairs as a list for select_pairs.method 'listed', so that the stage can be run again."""
        names = self.survey.names
        with atomic_path(self.folder / "pairs.txt") as temporary, temporary.open("w") as file:
            file.writelines(f"{names[i]} {names[j]}\n" for i, j in pairs.tolist())

    def write_matches(self, tile: str, pairs: Array) -> None:
        """The artifact of match_pairs for one tile."""
        truths = self._truths(tile)
        matches = [self._matches(truths, i, j) for i, j in pairs.tolist()]
        scores = [
            self._rng("scores", i, j).random(len(m)) for (i, j), m in zip(pairs, matches, strict=True)
        ]
        PairMatches(
            pairs=pairs,
            digests=self._pair_digests("matches", pairs),
            offsets=offsets_of([len(m) for m in matches]),
            matches=_join(matches, (0, 2), "int32"),
            scores=_join(scores, (0,), "float32"),
        ).write(self._path("match_pairs", tile), self._header("match_pairs"))

    def write_cameras(self) -> None:
        """The artifact of calibrate_cameras, where the intrinsics are given."""
        models, sizes, params, sources = cameras_to_columns([self.survey.camera])
        CalibratedCameras(
            np.array(models, dtype=object),
            sizes,
            params,
            np.array(sources, dtype=object),
            np.zeros(1),
            np.zeros(1, np.int32),
            np.zeros((0, 4), np.int32),
            np.zeros(0, dtype=object),
        ).write(self._path("calibrate_cameras", "cameras"), self._header("calibrate_cameras"))

    def write_geometries(self, tile: str, pairs: Array) -> None:
        """The artifact of estimate_two_view for one tile."""
        matched = PairMatches.read(self._path("match_pairs", tile))
        truths = self._truths(tile)
        count = len(pairs)
        rotations, translations = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        covariances, angles = np.full((count, 5, 5), np.nan), np.full(count, np.nan)
        rejections = np.full(count, REJECTIONS.index("too_few_inliers"), np.int8)
        inliers = []
        for row, (i, j) in enumerate(pairs.tolist()):
            matches = matched.matches[matched.offsets[row] : matched.offsets[row + 1]]
            shown = truths[i][0][matches[:, 0]], truths[j][0][matches[:, 1]]
            edge = simulate_edge(self.survey, (i, j), shown, self.model.noise_px, self.options.seed)
            inliers.append(matches[:0] if edge is None else matches[edge.inliers])
            if edge is not None:
                rotations[row], translations[row] = edge.rotation, edge.translation
                covariances[row], angles[row], rejections[row] = edge.covariance, edge.angle_deg, 0
        counts, inlier_counts = np.diff(matched.offsets), np.array([len(m) for m in inliers], np.int32)
        TwoViewGeometries(
            pairs=pairs,
            digests=self._pair_digests("geometry", pairs),
            rotations=rotations,
            translations=translations,
            covariances=covariances,
            kinds=np.zeros(count, np.int8),
            rejections=rejections,
            match_counts=counts.astype(np.int32),
            inlier_counts=inlier_counts,
            inlier_ratios=inlier_counts / np.maximum(counts, 1),
            triangulation_angles_deg=angles,
            offsets=offsets_of(inlier_counts),
            inliers=_join(inliers, (0, 2), "int32"),
        ).write(self._path("estimate_two_view", tile), self._header("estimate_two_view"))

    def write_config(self, listed: bool) -> None:
        """The configuration that lets Snakemake go on."""
        import yaml

        content: dict[str, Any] = {
            "images": str(self.folder / "images"),
            "output": str(self.folder / "results"),
            "scene": self.scene,
            "reference": str(self.folder / "reference"),
            "blocks": self.blocks,
        }
        # the same choice at all sizes: 'auto' would take all pairs of few images
        content["select_pairs"] = {"method": "sequential+retrieval"}
        # there are no images to refine keypoints in
        content["adjust_bundle"] = {"refine_keypoints": False}
        if listed:
            content |= {"pairs": str(self.folder / "pairs.txt"), "select_pairs": {"method": "listed"}}
        with atomic_path(self.folder / "config.yaml") as temporary:
            temporary.write_text(yaml.safe_dump(content, sort_keys=False), "utf-8")

    def _path(self, stage: str, file: str) -> Path:
        return self.folder / "results" / self.scene / stage / f"{file}.h5"

    def _header(self, stage: str) -> Header:
        options = options_class(stage)().resolved()
        if isinstance(options, SelectPairsOptions):
            # as the configuration that is written here has them
            options = options.model_copy(update={"method": "listed"}).resolve(self.options.images)
        return Header(stage, options.stage_version, self.scene, options.canonical_json())

    def _digest(self, *what: str) -> str:
        text = "\0".join(("simulated", repr(self.options), *what))
        return hashlib.sha256(text.encode()).hexdigest()

    def _pair_digests(self, what: str, pairs: Array) -> Array:
        return np.array([self._digest(what, str(i), str(j)) for i, j in pairs.tolist()], dtype=object)

    def _rng(self, what: str, i: int, j: int) -> np.random.Generator:
        return np.random.default_rng(derive_seed(self.options.seed, "simulate", what, str(i), str(j)))

    def _matches(self, truths: Truths, i: int, j: int) -> Array:
        return match_looks(truths[i][1], truths[j][1], RECALL, self._rng("matches", i, j))

    def _truths(self, tile: str) -> Truths:
        """What the keypoints of the tile's one or two blocks show."""
        truths: Truths = {}
        for block in sorted(set(tile.split("-"))):
            with np.load(self.folder / "truth" / f"{block}.npz") as file:
                shown = np.split(file["landmarks"], file["offsets"][1:-1])
                looks, rows = (np.split(file[name], file["distinct"][1:-1]) for name in ("looks", "rows"))
                for row, image in enumerate(file["image_ids"].tolist()):
                    truths[image] = shown[row], DistinctLooks(looks[row], rows[row])
        return truths

    def _rows_of_tiles(self, pairs: Array) -> Iterator[tuple[str, Array]]:
        blocks = np.sort(self.block_of[pairs], axis=1)
        for tile in tile_names(self.blocks):
            wanted = [int(part) for part in tile.split("-")]
            yield tile, np.flatnonzero((blocks == wanted).all(axis=1))

    def _tiles(self, pairs: Array) -> Iterator[tuple[str, Array]]:
        for tile, rows in self._rows_of_tiles(pairs):
            yield tile, pairs[rows]


def _join(parts: list[Array], shape: tuple[int, ...], dtype: str) -> Array:
    """All parts, and the right shape where there are none."""
    return np.concatenate([np.zeros(shape, dtype), *(part.astype(dtype) for part in parts)])


def main(arguments: list[str] | None = None) -> int:
    """Command line: 0 where the scene is there, 1 with one sentence where it cannot be made."""
    try:
        folder, options = parse_arguments(arguments)
        Simulation(folder, options).run()
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"{options.images} images simulated; go on with --configfile {folder}/config.yaml\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
