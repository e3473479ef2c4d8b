"""The stages from index to matches, run on rendered images."""

import cv2
import numpy as np
from plain_artifacts import write_plain_index

from snakesfm.artifacts import ImagePairs, LocalFeatures, PairMatches
from snakesfm.blocks import deal_blocks
from snakesfm.config.describe_images import DescribeImagesOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.learn_vocabulary import LearnVocabularyOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.geometry.camera import Camera
from snakesfm.ingest.discover import digest_images
from snakesfm.stages import describe_images, extract_features, learn_vocabulary, match_pairs, select_pairs
from snakesfm.stages.job import StageJob

NAMES = ["a/1 #{x}.png", "b/ü 2.png", "flat.png", "gone.png", "other.png", "shifted.png"]
SHIFT = (23, 7)


def texture(seed, height=240, width=320):
    rng = np.random.default_rng(seed)
    image = cv2.resize(rng.uniform(0, 255, (30, 40)), (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(160):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        size = int(rng.integers(3, 15))
        cv2.rectangle(image, (x, y), (x + size, y + size), float(rng.uniform(0, 255)), -1)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.2), 0, 255).astype(np.uint8)


class Scene:
    """The stages from index to matches, in one folder, with a number of blocks."""

    terminal = None

    def __init__(self, folder, images, blocks, gps=None, copies=()):
        self.folder, self.images, self.blocks = folder, images, blocks
        write_plain_index(
            self.file("index"),
            NAMES,
            [(320, 240)] * len(NAMES),
            [Camera("PINHOLE", 320, 240, ())],
            sha256=list(digest_images(images, NAMES).values()),
            blocks=deal_blocks(NAMES, blocks),
            duplicate_of=[0 if row in copies else -1 for row in range(len(NAMES))],
            refused_names=["bad.jpg"],
            refused_reasons=["bad.jpg is cut off."],
            gps=gps,
        )

    def file(self, name):
        return self.folder / f"{name}.h5"

    def job(self, stage, options, inputs, outputs, former=None, **settings):
        return StageJob(
            stage=stage,
            scene="scene",
            inputs=inputs,
            outputs=tuple(outputs),
            options=options,
            settings=settings,
            former=former,
            terminal=self.terminal,
        )

    def block_files(self, stage):
        return [self.file(f"{stage}/{block}") for block in range(self.blocks)]

    def tile_files(self, stage):
        return [self.file(f"{stage}/{a}-{b}") for a in range(self.blocks) for b in range(a, self.blocks)]

    def extract(self, options=None, former=None, **settings):
        for block, output in enumerate(self.block_files("features")):
            inputs = {"index": self.file("index")}
            extract_features.run(
                self.job(
                    "extract_features",
                    options or ExtractFeaturesOptions(max_keypoints=400),
                    inputs,
                    [output],
                    former and former.block_files("features")[block],
                    images=str(self.images),
                    block=block,
                    **settings,
                )
            )

    def describe(self):
        features = self.block_files("features")
        vocabulary = self.file("vocabulary")
        learn_vocabulary.run(
            self.job(
                "learn_vocabulary", LearnVocabularyOptions(words=8), {"features": features}, [vocabulary]
            )
        )
        for path, output in zip(features, self.block_files("descriptors"), strict=True):
            inputs = {"features": path, "vocabulary": vocabulary}
            describe_images.run(self.job("describe_images", DescribeImagesOptions(), inputs, [output]))

    def select(self, options, pairs_file=""):
        options = options.resolve(len(NAMES), pairs_file)
        descriptors = self.block_files("descriptors") if "retrieval" in options.method else []
        features = self.block_files("features") if options.looks_at_pairs else []
        inputs = {"index": self.file("index"), "descriptors": descriptors, "features": features}
        select_pairs.run(
            self.job(
                "select_pairs",
                options,
                inputs,
                self.tile_files("pairs"),
                blocks=self.blocks,
                pairs_file=pairs_file,
            )
        )
        rows = []
        for path in self.tile_files("pairs"):
            part = ImagePairs.read(path)
            columns = (part.reasons, part.similarities, part.likenesses)
            rows += list(zip(map(tuple, part.pairs), *columns, strict=True))
        return sorted(rows, key=lambda row: row[0])

    def match(self, options=None, former=None):
        for tile, output in enumerate(self.tile_files("matches")):
            blocks = sorted({int(part) for part in output.stem.split("-")})
            inputs = {
                "pairs": self.tile_files("pairs")[tile],
                "features": [self.block_files("features")[block] for block in blocks],
                "index": [],
            }
            match_pairs.run(
                self.job(
                    "match_pairs",
                    options or MatchPairsOptions(),
                    inputs,
                    [output],
                    former and former.tile_files("matches")[tile],
                )
            )
        found = {}
        for path in self.tile_files("matches"):
            part = PairMatches.read(path)
            for row, pair in enumerate(part.pairs):
                rows = slice(part.offsets[row], part.offsets[row + 1])
                found[tuple(pair.tolist())] = (part.matches[rows], part.scores[rows], part.digests[row])
        return found

    def features(self):
        found = {}
        for path in self.block_files("features"):
            part = LocalFeatures.read(path)
            for row, name in enumerate(part.names):
                rows = slice(part.offsets[row], part.offsets[row + 1])
                found[name] = {
                    column: getattr(part, column)[rows]
                    for column in ("keypoints", "descriptors", "scores", "scales", "angles", "colors")
                }
        return found
