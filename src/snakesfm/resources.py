"""Memory and time that a job requests from a cluster's scheduler.

Needs are straight lines above measured jobs (docs/cluster.md), in what a job works on, its images and
pairs; those of select_pairs are the pairs that it looks at. They never reach a stage, so they cannot change
a result.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from snakesfm.pipeline import STAGES

# the two Snakemake processes that stand around a job on a cluster's node, 130 MB each
AROUND_MB = 300
# a busy file system and a slow start take minutes without any work, less after another stage in one job
START_MIN, FOLLOWING_MIN = 15, 5
# extract_features.max_keypoints when needs were measured
MEASURED_KEYPOINTS = 5000
# extract_features.max_shorter_side_px when needs were measured, which stays if its default changes
MEASURED_SIDE_PX = 760
# larger photographs are rare: who asks for more wants them as they are
LARGEST_SIDE_PX = 6000


@dataclass(frozen=True)
class Load:
    """What one job works on.

    Parameters
    ----------
    images, pairs : number of images and of pairs of images.
    networks : number of networks that are run on each.
    batch : how many images or pairs a network holds in the job's memory at once.
    area : of the images in which keypoints are found, in those of the usual size.
    undistorting : how many images are undistorted at once; 0 where none is.
    keypoints : of an image at most, in those of the usual number.
    """

    images: float
    pairs: float
    networks: int = 0
    batch: int = 1
    area: float = 1.0
    undistorting: int = 0
    keypoints: float = 1.0


@dataclass(frozen=True)
class Need:
    """What a stage's job asks for: about twice what was measured, for images of MEASURED_KEYPOINTS.

    Parameters
    ----------
    grain : 'block', 'tile' or 'scene': what one job is of.
    constant_mb, image_mb, pair_mb : memory of the stage whatever it works on, per image, and per pair.
    image_s, pair_s : seconds per image and per pair.
    area_mb : memory that grows with the area of the images; their seconds then do, too.
    held_mb : what of constant_mb is for keypoints, with whose number it grows as image_mb and pair_mb do.
    """

    grain: str
    constant_mb: float
    image_mb: float = 0.0
    pair_mb: float = 0.0
    image_s: float = 0.0
    pair_s: float = 0.0
    area_mb: float = 0.0
    held_mb: float = 0.0


NEEDS = {
    "index_images": Need("scene", 500, 0.02, image_s=0.12),
    # SIFT took 265 MB of one image of 760 pixels, 864 of 1520 and 3180 of 3000
    "extract_features": Need("block", 1100, 2.0, image_s=1.8, area_mb=400),
    "learn_vocabulary": Need("scene", 1000, 0.01, image_s=0.1),
    "describe_images": Need("block", 500, 0.2, image_s=0.3),
    "select_pairs": Need("scene", 500, 0.15, 0.0005, image_s=0.2, pair_s=0.0012),
    # descriptors of 256 second images take 160 MB
    "match_pairs": Need("tile", 400, 0.02, 0.03, pair_s=0.12, held_mb=300),
    "merge_keypoints": Need("block", 600, 2.0, 0.1, image_s=1.0),
    "index_matches": Need("tile", 500, 2.0, 0.1, pair_s=0.1),
    # where images have cameras of their own: 40 kB for each of ten pairs, and a provisional model
    "calibrate_cameras": Need("scene", 500, 2.0, 0.0005, image_s=0.5),
    "estimate_two_view": Need("tile", 500, 0.2, 0.03, pair_s=0.12),
    "build_view_graph": Need("scene", 300, 0.01, 0.002, image_s=0.06),
    "filter_view_graph": Need("scene", 800, 0.02, 0.002, image_s=0.12),
    "average_rotations": Need("scene", 600, 0.05, 0.01, image_s=0.25),
    # 120 bytes per match, of which pairs of videos and turntables have over a thousand
    "build_tracks": Need("scene", 400, 1.2, 0.1, image_s=0.2),
    # 25 shared rays of each pair, at 470 bytes, where all images see the same
    "average_translations": Need("scene", 600, 1.6, 0.012, image_s=1.2),
    "triangulate_tracks": Need("scene", 600, 1.6, image_s=0.25),
    "adjust_bundle": Need("scene", 800, 4.5, 0.01, image_s=2.4),
    "export_database": Need("scene", 600, 1.0, 0.03, image_s=0.1, pair_s=0.01),
    "export_hloc": Need("scene", 600, 1.0, 0.03, image_s=0.1, pair_s=0.01),
    "export_model": Need("scene", 600, 1.6, image_s=0.2),
    "evaluate_model": Need("scene", 800, 0.2, image_s=0.06),
    "render_report": Need("scene", 600, 0.5, image_s=0.06),
}


# what a network takes beside, on a processor: LoFTR took 1.6 GB with the images that it holds, and 8.4 s
# per pair of 840 x 632, and DISK 2.0 GB more for every further image of 1140 x 760 in a batch
NETWORK_MB, NETWORK_IMAGE_S, NETWORK_PAIR_S = 2600, 10.0, 17.0

UNDISTORTING_THREADS = 4
# each image of 24 megapixels, which is 72 MB decoded: one thread took 0.8 s for a JPEG of 6 megapixels, and
# memory is estimated from the decoded and the undistorted image, and their copies where it is no JPEG
UNDISTORTED_MB, UNDISTORTED_S = 500, 7.0


def job_load(
    stage: str,
    images: int,
    blocks: int,
    pairs: int,
    networks: int = 0,
    batch: int = 1,
    shorter_side_px: int = MEASURED_SIDE_PX,
    max_keypoints: int | Literal["auto"] = "auto",
) -> Load:
    """What one job of a stage works on, on average over the scene's blocks or tiles.

    ``shorter_side_px`` is what images are scaled down to before keypoints are found, of which each keeps
    ``max_keypoints``.
    """
    grain = NEEDS[stage].grain
    keypoints = 1.0 if max_keypoints == "auto" else max(1.0, max_keypoints / MEASURED_KEYPOINTS)
    if grain == "block":
        side = min(shorter_side_px, LARGEST_SIDE_PX)
        area = (side / MEASURED_SIDE_PX) ** 2 if NEEDS[stage].area_mb else 1.0
        # the pairs of a block's images are those of its tiles
        of_block = pairs * (2 * blocks - 1) / blocks**2 if NEEDS[stage].pair_mb else 0
        return Load(images / blocks, of_block, networks, batch, area, keypoints=keypoints)
    if grain == "tile":
        tiles = blocks * (blocks + 1) / 2
        return Load(min(2 / blocks, 1) * images, pairs / tiles, networks, batch, keypoints=keypoints)
    return Load(images, pairs, networks, batch, keypoints=keypoints)


def memory_mb(stage: str, load: Load, attempt: int = 1) -> int:
    """Megabytes that a stage's job asks for; each further attempt asks for twice as much."""
    need = NEEDS[stage]
    own = need.constant_mb + need.held_mb * (load.keypoints - 1)
    own += (need.image_mb * load.images + need.pair_mb * load.pairs) * load.keypoints
    own += (need.area_mb + NETWORK_MB * load.networks * load.batch) * load.area
    own += UNDISTORTED_MB * load.undistorting
    return 100 * math.ceil((AROUND_MB + own) / 100) << (attempt - 1)


def start_min(stage: str, groups: Mapping[str, str]) -> int:
    """Minutes that a stage's job asks for without any work.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    groups : of stages that are one job, by stage; such a job asks for the sum of their times.
    """
    group, former = groups.get(stage), STAGES[: STAGES.index(stage)]
    follows = group is not None and group in map(groups.get, former)
    return FOLLOWING_MIN if follows else START_MIN


def runtime_min(stage: str, load: Load, attempt: int = 1, start: int = START_MIN) -> int:
    """Minutes that a stage's job asks for, ``start`` of them without work; each further attempt: twice."""
    need = NEEDS[stage]
    seconds = need.image_s * load.images * load.area + need.pair_s * load.pairs
    # a tile's network sees its pairs, a block's its images
    seconds += load.networks * (
        NETWORK_PAIR_S * load.pairs if load.pairs else NETWORK_IMAGE_S * load.images * load.area
    )
    if load.undistorting:
        seconds += UNDISTORTED_S * load.images / load.undistorting
    return (start + math.ceil(seconds / 60)) << (attempt - 1)
