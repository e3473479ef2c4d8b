"""The files that jobs of a scene, tile or block read, where these depend on the scene's methods."""

from snakesfm.blocks import tile_names
from snakesfm.front_ends import LEARNED_METHODS
from snakesfm.scene_plan import ScenePlan


def keypoint_files(scene: ScenePlan) -> list[str]:
    """The keypoints of all blocks that the stages after matching read."""
    return scene.files(scene.features_stage, "blocks")


def exported_keypoints(scene: ScenePlan) -> list[str]:
    """The keypoints of all blocks where the model is written with all of them, else nothing."""
    return keypoint_files(scene) if scene.configuration.export_model.all_keypoints else []


def match_files(scene: ScenePlan) -> list[str]:
    """The matches of all tiles that the stages after matching read."""
    return scene.files(scene.matches_stage, "tiles")


def coordinate_files(scene: ScenePlan) -> list[str]:
    """What was matched without keypoints in all tiles, else nothing."""
    return scene.files("match_pairs", "tiles") if scene.detector_free else []


def tile_features(scene: ScenePlan, tile: str) -> list[str]:
    """The one or two blocks of keypoints that belong to a tile's matches."""
    blocks = sorted({int(block) for block in tile.split("-")})
    return [scene.file(scene.features_stage, str(block)) for block in blocks]


def tile_matches(scene: ScenePlan, tile: str) -> str:
    """The matches of a tile that the stages after matching read."""
    return scene.file(scene.matches_stage, tile)


def matched_features(scene: ScenePlan, tile: str) -> list[str]:
    """The one or two blocks of keypoints that a tile matches, nothing where it matches images."""
    return [] if scene.detector_free else tile_features(scene, tile)


def matched_images(scene: ScenePlan) -> list[str]:
    """The index where a tile matches images, or their keypoints by a network, else nothing."""
    needed = scene.detector_free or scene.method("match_pairs") in LEARNED_METHODS
    return [scene.file("index_images", "index")] if needed else []


def block_tiles(scene: ScenePlan, block: str) -> list[str]:
    """The tiles of coordinates with a block's images."""
    tiles = [name for name in tile_names(scene.blocks) if block in name.split("-")]
    return [scene.file("match_pairs", name) for name in tiles]


def global_descriptors(scene: ScenePlan) -> list[str]:
    """The global descriptors of all blocks where pairs are retrieved, else nothing."""
    return scene.files("describe_images", "blocks") if scene.select_pairs.needs_descriptors else []


def previewed_features(scene: ScenePlan) -> list[str]:
    """The features of all blocks if pairs are previewed before they are chosen, else nothing."""
    return scene.files("extract_features", "blocks") if scene.select_pairs.looks_at_pairs else []


def described_features(scene: ScenePlan, block: str) -> list[str]:
    """A block's local features where these describe its images, else nothing."""
    return [] if scene.describes_pictures else [scene.file("extract_features", block)]


def described_images(scene: ScenePlan) -> list[str]:
    """The index where a network describes the images themselves, else nothing."""
    return [scene.file("index_images", "index")] if scene.describes_pictures else []
