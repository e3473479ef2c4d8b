"""The files between the stages: one dataclass per kind, with its reader and writer."""

from snakesfm.artifacts.base import Artifact, Header, read_header, temporary_folder, write_json
from snakesfm.artifacts.features import GlobalDescriptors, LocalFeatures, Vocabulary
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.mapping import (
    CameraCenters,
    CameraRotations,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
)
from snakesfm.artifacts.pairs import ImagePairs, PairCoordinates, PairMatches, TwoViewGeometries, ViewGraph

ARTIFACTS: tuple[type[Artifact], ...] = (
    ImageIndex,
    LocalFeatures,
    Vocabulary,
    GlobalDescriptors,
    ImagePairs,
    PairMatches,
    PairCoordinates,
    CalibratedCameras,
    TwoViewGeometries,
    ViewGraph,
    CameraRotations,
    TrackTable,
    CameraCenters,
    TriangulatedPoints,
    Reconstruction,
)

__all__ = [
    "ARTIFACTS",
    "Artifact",
    "CalibratedCameras",
    "CameraCenters",
    "CameraRotations",
    "GlobalDescriptors",
    "Header",
    "ImageIndex",
    "ImagePairs",
    "LocalFeatures",
    "PairCoordinates",
    "PairMatches",
    "Reconstruction",
    "TrackTable",
    "TriangulatedPoints",
    "TwoViewGeometries",
    "ViewGraph",
    "Vocabulary",
    "read_header",
    "temporary_folder",
    "write_json",
]
