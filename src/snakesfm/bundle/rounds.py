"""The chained rounds of bundle adjustment."""

from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import replace
from typing import Literal

from snakesfm.bundle.completion import complete_tracks
from snakesfm.bundle.filtering import (
    deregister_images_alone,
    deregister_weak_images,
    drop_short_tracks,
    filter_observations,
)
from snakesfm.bundle.focal_pairs import (
    find_square_cameras,
    find_stretched_cameras,
    skewed_cameras,
    with_equal_focals,
    with_one_focal,
    with_two_focals,
)
from snakesfm.bundle.image_sources import ImageSource
from snakesfm.bundle.interface import SolverSettings, bundle_adjuster
from snakesfm.bundle.keypoint_noise import keypoint_noise_px
from snakesfm.bundle.keypoint_refinement import refine_by_sources
from snakesfm.bundle.lenses import find_wider_lenses
from snakesfm.bundle.mixed_focals import find_mixed_focals
from snakesfm.bundle.principal_points import find_told_cameras, shared_cameras
from snakesfm.bundle.registration import left_out_images, register_left_out
from snakesfm.bundle.round_settings import RoundRecord, RoundSettings
from snakesfm.bundle.selection import adjust_selection
from snakesfm.bundle.sharpness import find_blurred
from snakesfm.bundle.trials import read_cameras, set_cameras
from snakesfm.bundle.wild_cameras import WildCause, longest_focals_px, reset_wild_cameras
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap

EARLY_TOLERANCE = 300.0
# of the longest plausible focal length: the rays of such a lens are all but parallel
LONG_LENS_SHARE = 0.5
# of the mean reprojection error, what another round leaves where principal points have arrived
SETTLED_SHARE = 0.9
# of the images, those that are registered before another pass
PASS_SHARE = 0.05
# early rounds come before all observations are there, final ones after, the last of which is exact
Phase = Literal["early", "final", "last"]

# a pass may take so many steps times observations, about a second, in whatever many steps
CHEAP_STEPS = 2_000_000
MOST_STEPS = 500
# of exact keypoints the model shows no noise but that of float32 and of the solver
EXACT_PX = 0.05


def adjust_rounds(
    reconstruction: pycolmap.Reconstruction,
    read_graph: Callable[[], pycolmap.CorrespondenceGraph],
    cameras: Sequence[Camera],
    solving: SolverSettings,
    settings: RoundSettings,
    report: Callable[[RoundRecord], None],
    sources: Sequence[ImageSource] = (),
) -> None:
    """Adjust, filter and complete a model in rounds that each start from the result of the one before.

    Parameters
    ----------
    reconstruction : changed in place.
    read_graph : gives the inlier matches for completion and registration; the last pass does not hold them.
    cameras : the intrinsics at the start.
    solving : how each pass is solved.
    settings : what is done in and between the rounds.
    report : called with each record as soon as it is there.
    sources : the images, where keypoints are to be refined before the last round but one, by each in turn.
    """
    mapper = _Mapper(reconstruction, read_graph, cameras, solving, settings, report)
    last = len(settings.thresholds_px) - 1
    for row, threshold in enumerate(settings.thresholds_px):
        number = row + 1
        phase: Phase = "final" if row == last else "early"
        refining = sources if row == max(last - 1, 0) else ()
        # what completion adds is not refined, so it ends where refinement begins
        completing = bool(row) and settings.complete_tracks and (not sources or row < last)
        mapper.prepare(completing, refining)
        mapper.round(f"round {number}", threshold, phase, holds_distortion=number == 1)
        # before that, distortion was held
        if 0 < row == last - 1 and mapper.widen_lenses():
            mapper.prepare(completing, refining)
            mapper.round(f"round {number} with wider lenses", threshold, phase)
    while settings.register_images and mapper.register():
        mapper.round("registration", settings.thresholds_px[-1], "final")
    if settings.refine_principal_points and mapper.may_try_lenses:
        mapper.refine_principal_points(sources)
    mapper.drop_outliers()
    mapper.look_for_mixed_focals()
    if settings.register_images:
        mapper.set_long_lenses_aside()
    mapper.round("last pass", settings.thresholds_px[-1], "last")
    mapper.tie_focal_lengths()
    if settings.register_images:
        mapper.add_left_out()


class _Mapper:
    """The model and what happens to it."""

    def __init__(
        self,
        reconstruction: pycolmap.Reconstruction,
        read_graph: Callable[[], pycolmap.CorrespondenceGraph],
        cameras: Sequence[Camera],
        solving: SolverSettings,
        settings: RoundSettings,
        report: Callable[[RoundRecord], None],
    ) -> None:
        self.reconstruction = reconstruction
        self.read_graph = read_graph
        self.cameras = list(cameras)
        self.solving = solving
        self.settings = settings
        self.report = report
        self.records: list[RoundRecord] = []
        self.registered_late: set[int] = set()
        self.blurred: list[int] | None = None
        self.far: Mapping[int, float] = {}
        self.mixed: Mapping[int, float] = {}
        self.adjust = bundle_adjuster(settings.solver)
        self.held_graph: pycolmap.CorrespondenceGraph | None = None

    def round(self, name: str, threshold_px: float, phase: Phase, holds_distortion: bool = False) -> None:
        """One pass of the solver and the filters after it; all but the last are coarse.

        An early one may hold the distortion, which would make up for a wrong focal length. A camera gone
        wild is held until the pass ends: the next one starts from better poses and points.
        """
        settings = self.settings
        if phase == "early":
            solving = self.early_solving(threshold_px, holds_distortion)
        else:
            # the solver takes most memory in the last pass, and few models need their matches again
            if phase == "last" or not left_out_images(self.reconstruction, self.registered_late):
                self.held_graph = None
            solving = self.late_solving(phase)
        drop_short_tracks(self.reconstruction, settings.min_track_length, settings.sparse_observations)
        costs, wild, held = self.solve_with_wild_held(solving, phase)
        self.filter(threshold_px)
        if phase != "early":
            deregister_weak_images(self.reconstruction, settings.min_observations)
        self.record(name, costs, wild, held)

    def early_solving(self, threshold_px: float, holds_distortion: bool) -> SolverSettings:
        """How a round before the final ones is solved."""
        settings, solving = self.settings, self.solving
        return replace(
            solving,
            function_tolerance=solving.function_tolerance * EARLY_TOLERANCE,
            loss_scale_px=settings.early_loss_share * threshold_px,
            # the few steps of a coarse pass cost less than these need to be prepared
            inner_iterations=False,
            refine_distortion=solving.refine_distortion and not holds_distortion,
        )

    def late_solving(self, phase: Literal["final", "last"]) -> SolverSettings:
        """How a pass is solved on the model as it is, whose noise tells where the loss sets in."""
        solving = replace(self.solving, loss_scale_px=self.loss_scale_px())
        if phase == "last":
            return replace(solving, loss=self.settings.last_loss)
        return replace(solving, function_tolerance=solving.function_tolerance * EARLY_TOLERANCE)

    def solve_with_wild_held(
        self, solving: SolverSettings, phase: Phase
    ) -> tuple[tuple[float, float], Mapping[int, WildCause], Mapping[int, WildCause]]:
        """One pass, solved again with the cameras held that went wild; its costs, these, and those held."""
        settings = self.settings
        before = {k: list(camera.params) for k, camera in self.reconstruction.cameras.items()}
        costs = self.solve(solving, phase)
        wild = reset_wild_cameras(
            self.reconstruction,
            self.cameras,
            before,
            settings.max_focal_change,
            settings.max_guessed_focal_change,
            settings.max_distortion,
        )
        if not wild:
            return costs, wild, wild
        gone: Set[int] = frozenset()
        if phase == "last" and settings.register_images:
            # no pass is left for their focal lengths: their images are added to the finished model
            stray = {camera_id for camera_id, cause in wild.items() if cause == "focal length"}
            gone = deregister_images_alone(self.reconstruction, stray)
        constant = solving.constant_cameras | frozenset(wild)
        costs = self.solve(replace(solving, constant_cameras=constant), phase)
        return costs, wild, {k: cause for k, cause in wild.items() if k not in gone}

    def prepare(self, completing: bool, sources: Sequence[ImageSource]) -> None:
        """What comes before a round: tracks are completed, and keypoints refined by each of ``sources``."""
        if completing:
            self.complete()
        if sources and self.blurred is None:
            self.blurred = find_blurred(self.reconstruction, sources[0])
        refine_by_sources(self.reconstruction, sources, self.blurred or ())

    def widen_lenses(self) -> bool:
        """After a round, give cameras whose lens is not of their model a wider one; whether some were."""
        settings = self.settings
        if not settings.widen_lenses or not self.may_try_lenses:
            return False
        trying = self.reconstruction, self.adjust, self.late_solving("final")
        fisheyes = find_wider_lenses(*trying)
        wider = fisheyes or find_stretched_cameras(*trying)
        set_cameras(self.reconstruction, wider)
        for camera_id, camera in wider.items():
            # what goes wild later goes back to it; the focal lengths of a lens, once equal, may be tied
            start = with_equal_focals(camera) if fisheyes else camera
            self.cameras[camera_id - 1] = replace(start, source=self.cameras[camera_id - 1].source)
        return bool(wider)

    def tie_focal_lengths(self) -> None:
        """Adjust once more with one focal length where two came apart that the images do not tell."""
        settings = self.settings
        skewed = skewed_cameras(self.reconstruction, self.cameras)
        if not skewed or settings.solver != "ceres":
            return
        solving = self.late_solving("last")
        square = find_square_cameras(self.reconstruction, skewed, self.adjust, solving)
        if not square:
            return
        # what was just changed does not show the noise of its keypoints
        self.settings = replace(settings, loss_scale_px=solving.loss_scale_px)
        starts = list(self.cameras)
        set_cameras(self.reconstruction, square)
        for camera_id in square:
            self.cameras[camera_id - 1] = with_one_focal(starts[camera_id - 1])
        self.round("last pass with one focal length", settings.thresholds_px[-1], "last")
        tied = read_cameras(self.reconstruction, square)
        two = {k: with_two_focals(camera, starts[k - 1].model) for k, camera in tied.items()}
        set_cameras(self.reconstruction, two)
        self.cameras, self.settings = starts, settings

    def record(
        self,
        name: str,
        costs: tuple[float, float],
        wild: Mapping[int, WildCause],
        held: Mapping[int, WildCause],
    ) -> None:
        """Take down what was done, and report it."""
        model = self.reconstruction
        model.update_point_3d_errors()
        counts = model.num_reg_images(), model.num_points3D(), model.compute_num_observations()
        error_px = float(model.compute_mean_reprojection_error())
        record = RoundRecord(name, costs, counts, error_px, wild, held, self.far, self.mixed)
        self.records.append(record)
        self.report(record)

    def solve(self, solving: SolverSettings, phase: Phase) -> tuple[float, float]:
        """One pass of the solver, in large models on as many observations as the settings say."""
        settings = self.settings
        if settings.patient:
            cheap = CHEAP_STEPS // max(self.reconstruction.compute_num_observations(), 1)
            steps = max(solving.max_iterations, min(cheap, MOST_STEPS))
            solving = replace(solving, max_iterations=steps)
        per_image = settings.final_observations if phase == "last" else settings.early_observations
        if not per_image or self.reconstruction.num_reg_images() <= settings.select_above_images:
            return self.adjust(self.reconstruction, solving)
        return adjust_selection(self.reconstruction, self.adjust, solving, per_image, settings.seed)

    def refine_principal_points(self, sources: Sequence[ImageSource]) -> None:
        """One more round in which the principal points that the model tells are free.

        Where one moves far, more follow until the errors hardly fall: coarse passes end on the way, and
        observations come back that the model before had bent or lost.
        """
        settings = self.settings
        solving = replace(self.solving, loss_scale_px=self.loss_scale_px())
        offsets = settings.min_principal_point_offset, settings.max_principal_point_offset
        trying = self.reconstruction, self.adjust, solving
        found = find_told_cameras(*trying, settings.max_principal_point_gap, offsets)
        self.far = found.refused
        if not found.told:
            return
        before = self.solving
        held = frozenset(self.reconstruction.cameras).difference(found.told)
        self.solving = replace(before, constant_cameras=held, refine_principal_points=True)
        self.round("principal points", settings.thresholds_px[-1], "final")
        settled = not found.moves_far
        while not settled:
            self.prepare(settings.complete_tracks, sources)
            self.round("principal points again", settings.thresholds_px[-1], "final")
            settled = not self.records[-1].error_px < SETTLED_SHARE * self.records[-2].error_px
        self.solving = before

    def look_for_mixed_focals(self) -> None:
        """See which images share a camera though their focal lengths differ."""
        if self.may_try_lenses:
            self.mixed = find_mixed_focals(self.reconstruction, self.adjust, self.late_solving("final"))

    def drop_outliers(self) -> None:
        """Drop observations so far off that the keypoints' noise does not explain them."""
        settings = self.settings
        self.filter(max(settings.outlier_sigmas * keypoint_noise_px(self.reconstruction), EXACT_PX))

    def filter(self, max_error_px: float) -> None:
        """Drop observations with larger errors, and the points that do not hold without them."""
        settings = self.settings
        filter_observations(
            self.reconstruction,
            max_error_px,
            settings.min_angle_deg,
            settings.min_track_length,
            settings.sparse_observations,
        )

    @property
    def may_try_lenses(self) -> bool:
        """Whether the model may tell of a camera's lens; else its noise need not be measured for that."""
        shared = shared_cameras(self.reconstruction, self.solving.constant_cameras)
        return self.settings.solver == "ceres" and bool(shared)

    def loss_scale_px(self) -> float:
        """Where the loss of a final round sets in."""
        settings = self.settings
        if settings.loss_scale_px != "auto":
            return settings.loss_scale_px
        return settings.loss_scale_sigmas * keypoint_noise_px(self.reconstruction)

    @property
    def graph(self) -> pycolmap.CorrespondenceGraph:
        """The inlier matches, read where they are not held."""
        if self.held_graph is None:
            self.held_graph = self.read_graph()
        return self.held_graph

    def complete(self, images: Sequence[int] | None = None) -> None:
        """Complete and merge all tracks, and triangulate what ``images`` (all if None) left out."""
        settings = self.settings
        complete_tracks(
            self.reconstruction,
            self.graph,
            settings.complete_error_px,
            settings.min_angle_deg,
            settings.seed,
            images,
        )

    def register(self) -> bool:
        """Register what can be, some after others until a pass is worth it; whether something was.

        An image that the adjustment throws out again is not tried twice, or that would go on for ever.
        """
        limits = self.settings.register_error_px, self.settings.register_min_inliers
        before = self.reconstruction.num_reg_images()
        done = self.place_left_out(*limits, self.registered_late)
        while done:
            self.registered_late.update(done)
            self.complete(done)
            enough = self.reconstruction.num_reg_images() >= (1 + PASS_SHARE) * before
            done = [] if enough else self.place_left_out(*limits, self.registered_late)
        return bool(self.reconstruction.num_reg_images() > before)

    def set_long_lenses_aside(self) -> None:
        """Take out single images of lenses so long that the last pass would not settle them."""
        focal_px = {k: camera.mean_focal_length() for k, camera in self.reconstruction.cameras.items()}
        long = [k for k, most in self.max_focals_px().items() if focal_px[k] > LONG_LENS_SHARE * most]
        deregister_images_alone(self.reconstruction, long)

    def add_left_out(self) -> None:
        """Register what is left out on the finished model, which stays as it is.

        Lenses so long that their rays are parallel, and images that would bend the model, find a pose so.
        """
        settings = self.settings
        least = max(settings.register_min_inliers, settings.min_observations)
        if self.place_left_out(settings.thresholds_px[-1], least):
            last = self.records[-1]
            self.record("left-out images", (last.costs[1],) * 2, {}, last.held)

    def place_left_out(
        self, max_error_px: float, min_inliers: int, refused: Collection[int] = ()
    ) -> list[int]:
        """Give images without a pose one, but for the rows ``refused``; the rows of those that got one."""
        # the matches are not read for nothing
        if not left_out_images(self.reconstruction, refused):
            return []
        return register_left_out(
            self.reconstruction,
            self.graph,
            max_error_px,
            min_inliers,
            self.settings.register_min_ratio,
            self.max_focals_px(),
            self.settings.seed,
            refused,
        )

    def max_focals_px(self) -> dict[int, float]:
        """The longest plausible focal length of each camera, by id, whose own is guessed and free."""
        if not self.solving.refine_focal:
            return {}
        longest = longest_focals_px(self.cameras, self.settings.max_guessed_focal_change)
        return {k: most for k, most in longest.items() if k not in self.solving.constant_cameras}
