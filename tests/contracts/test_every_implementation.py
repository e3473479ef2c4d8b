"""Every interface has a contract, and everything that can be chosen for it is under that contract."""

import ast
import importlib
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import get_args

import pytest
from contracts.test_bundle_adjuster_solvers import BundleAdjusterContract
from contracts.test_detector_free_matchers import DetectorFreeContract
from contracts.test_detectors import DetectorContract
from contracts.test_global_descriptors import GlobalDescriptorContract
from contracts.test_keypoint_sources import KeypointSourceContract, PointSourceContract
from contracts.test_matchers import MatcherContract
from contracts.test_pair_selectors import PairSelectorContract
from contracts.test_pose_refinements import PoseRefinementContract
from contracts.test_relative_pose_estimators import RelativePoseContract
from contracts.test_rotation_averager_contract import AveragerContract
from contracts.test_surveys import SurveyContract
from contracts.test_translation_averager_contract import TranslationAveragerContract
from contracts.test_triangulator_methods import TriangulatorContract
from contracts.test_view_graph_filters import ViewGraphFilterContract

from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.config.average_rotations import AverageRotationsOptions
from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.config.base import StageOptions
from snakesfm.config.estimate_two_view import EstimateTwoViewOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.filter_view_graph import FilterViewGraphOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.config.triangulate_tracks import TriangulateTracksOptions
from snakesfm.features import virtual_points
from snakesfm.features.extraction import DETECTORS
from snakesfm.front_ends import DETECTOR_FREE, FRONT_ENDS
from snakesfm.matching.detector_free import DETECTOR_FREE_MATCHERS
from snakesfm.matching.matcher import MATCHERS
from snakesfm.retrieval.descriptor import DESCRIPTORS
from snakesfm.retrieval.pairs import REASONS
from snakesfm.synthetic.surveys import SURVEYS
from snakesfm.two_view.estimators import ESTIMATORS

# suites may be in other files than their contract
for file in sorted(Path(__file__).parent.glob("test_*.py")):
    if file.stem != Path(__file__).stem:
        importlib.import_module(f"contracts.{file.stem}")


def options(kind: type[StageOptions], name: str) -> set[str]:
    """What an option of a stage may be set to."""
    return set(get_args(kind.model_fields[name].annotation))


METHODS = options(MatchPairsOptions, "method")
POINT_SOURCES = {
    kind
    for kind in vars(virtual_points).values()
    if isinstance(kind, type) and hasattr(kind, "seen_by") and kind is not virtual_points.PointSource
}
PAIRED = {(end.matcher, end.detector) for end in FRONT_ENDS.values() if end.matcher not in DETECTOR_FREE}
# interface: its contract, what its suites say that they test, and all that can be chosen
CONTRACTS = {
    "Detector": (DetectorContract, "method", set(DETECTORS)),
    "KeypointSource": (
        KeypointSourceContract,
        "method",
        options(ExtractFeaturesOptions, "method") - set(DETECTORS),
    ),
    "PointSource": (PointSourceContract, "kind", POINT_SOURCES),
    "GlobalDescriptor": (GlobalDescriptorContract, "method", set(DESCRIPTORS)),
    "choice of pairs": (PairSelectorContract, "reason", set(REASONS)),
    "Matcher": (MatcherContract, "method", METHODS - set(DETECTOR_FREE)),
    "registered Matcher": (MatcherContract, "method", {*MATCHERS, "imported"}),
    "DetectorFreeMatcher": (DetectorFreeContract, "method", METHODS & set(DETECTOR_FREE)),
    "registered DetectorFreeMatcher": (DetectorFreeContract, "method", set(DETECTOR_FREE_MATCHERS)),
    "PoseEstimator": (RelativePoseContract, "name", options(EstimateTwoViewOptions, "estimator")),
    "registered PoseEstimator": (RelativePoseContract, "name", set(ESTIMATORS)),
    "refinement of a pose": (PoseRefinementContract, "method", options(EstimateTwoViewOptions, "refine")),
    "filter of the view graph": (
        ViewGraphFilterContract,
        "method",
        options(FilterViewGraphOptions, "method"),
    ),
    "RotationAverager": (AveragerContract, "method", options(AverageRotationsOptions, "method")),
    "TranslationAverager": (
        TranslationAveragerContract,
        "method",
        options(AverageTranslationsOptions, "method"),
    ),
    "Triangulator": (TriangulatorContract, "method", options(TriangulateTracksOptions, "method")),
    "BundleAdjuster": (BundleAdjusterContract, "solver", options(AdjustBundleOptions, "solver")),
    "Survey": (SurveyContract, "name", set(SURVEYS)),
}


def suites_of(contract: type) -> Iterator[type]:
    """The classes that inherit a contract and that pytest runs."""
    for suite in contract.__subclasses__():
        if suite.__name__.startswith("Test"):
            yield suite
        yield from suites_of(suite)


@pytest.mark.parametrize("interface", CONTRACTS)
def test_all_that_can_be_chosen_is_under_contract(interface: str) -> None:
    contract, attribute, choices = CONTRACTS[interface]
    assert choices
    assert {getattr(suite, attribute) for suite in suites_of(contract)} == choices


def test_matchers_are_tested_with_all_detectors_that_they_go_with() -> None:
    named = attrgetter("method", "detector")
    assert {named(suite) for suite in suites_of(MatcherContract)} == PAIRED


def test_every_interface_has_a_contract(root: Path) -> None:
    interfaces = {
        node.name
        for file in (root / "src").rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
        and {ast.unparse(base) for base in node.bases} & {"Protocol", "ABC"}
    }
    # what takes several inputs at once is what takes one as well
    assert interfaces - {"BatchDetector", "BatchMatcher"} <= set(CONTRACTS)
    assert len(interfaces) > 10
