"""Options of select_pairs."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from snakesfm.config.base import StageOptions

MANY_IMAGES = 500
# a look at a pair takes half a millisecond, matching it fifteen
MANY_IMAGES_TO_LOOK_AT = 1_000
SHORTLIST = 100


class SelectPairsOptions(StageOptions):
    """Which pairs of images are matched."""

    stage_version: ClassVar[int] = 4

    method: Literal[
        "auto",
        "exhaustive",
        "sequential",
        "retrieval",
        "spatial",
        "sequential+retrieval",
        "sequential+spatial",
        "listed",
    ] = "auto"
    """All pairs, neighbours by name, similar images, neighbours by GPS, or a list's; 'auto' decides."""

    exhaustive_up_to: Annotated[int, Field(ge=2, le=100_000)] | Literal["auto"] = "auto"
    """Images up to which 'auto' takes all pairs: itself 1000 where pairs are looked at, else 500."""

    look_ahead: int = Field(10, ge=1, le=10_000)
    """How many following images, in the natural order of names, an image is paired with by 'sequential'."""

    top_k: Annotated[int, Field(ge=1, le=100_000)] | Literal["auto"] = "auto"
    """Similar or near images that are proposed; 'auto' is 100 to look at, else 15, 30 from 500 images."""

    min_score: float = Field(0.0, ge=-1.0, le=1.0)
    """Least similarity of a pair chosen by 'retrieval'."""

    preview_keypoints: int = Field(400, ge=0, le=10_000)
    """Largest SIFT keypoints by which proposed pairs are looked at before they are matched (0: no look)."""

    min_likeness: float = Field(1.5, ge=0.0)
    """Least resemblance of these keypoints in a pair that is matched; higher leaves more pairs out."""

    least_partners: int = Field(16, ge=0, le=10_000)
    """Partners that each image keeps, the most alike ones, however little they resemble it."""

    enough_partners: int = Field(30, ge=0, le=10_000)
    """Partners that each image keeps: half the most alike, half every second of the next (0: all)."""

    enough_likeness: float = Field(250.0, ge=0.0)
    """Images that resemble theirs little keep more, until likeness sums to this."""

    def resolve(self, image_count: int, pairs_file: str = "", detector: str = "sift") -> Self:
        """The options with every 'auto' replaced by what it means for a number of images.

        Parameters
        ----------
        image_count : number of images of the scene.
        pairs_file : path of the user's list of pairs, or "" for none; 'auto' follows a list that is given.
        detector : whose keypoints there are before pairs are chosen, or "" for none. Only SIFT's are looked
            at: others have no scales, and what their descriptors resemble was never measured.
        """
        look = self.preview_keypoints > 0 and detector == "sift"
        most = self.exhaustive_up_to
        if most == "auto":
            most = MANY_IMAGES_TO_LOOK_AT if look else MANY_IMAGES
        method = self.method
        if method == "auto":
            if pairs_file:
                method = "listed"
            else:
                method = "exhaustive" if image_count <= most else "sequential+retrieval"
        look = look and method not in ("sequential", "listed")
        top_k = self.top_k
        if top_k == "auto":
            top_k = SHORTLIST if look else 30 if image_count >= MANY_IMAGES else 15
        return self.model_copy(
            update={
                "method": method,
                "exhaustive_up_to": most,
                "top_k": top_k,
                "preview_keypoints": self.preview_keypoints if look else 0,
            }
        )

    @property
    def needs_descriptors(self) -> bool:
        """Whether global descriptors of the images are needed.

        Raises
        ------
        ValueError : the method is still 'auto'; call :meth:`resolve` first.
        """
        if self.method == "auto":
            raise ValueError("resolve the options before asking what they need")
        return "retrieval" in self.method

    @property
    def looks_at_pairs(self) -> bool:
        """Whether keypoints are looked at before pairs are chosen, once the options are resolved."""
        return self.preview_keypoints > 0

    def count_proposed(self, images: int, listed: int = 0) -> int:
        """Most pairs that the method proposes of so many images, or of a list of so many pairs."""
        everything = images * (images - 1) // 2
        if self.method == "exhaustive":
            return everything
        if self.method == "listed":
            return min(listed, everything)
        # a similar image is mostly found from one side alone
        per_image = self.look_ahead * ("sequential" in self.method)
        per_image += int(self.top_k) * (self.needs_descriptors or "spatial" in self.method)
        return min(images * per_image, everything)

    def count_chosen(self, images: int, proposed: int) -> int:
        """How many of the proposed pairs stay after the look, at most where links are not weak."""
        limited = self.looks_at_pairs and self.enough_partners > 0
        return min(images * self.enough_partners, proposed) if limited else proposed
