"""Options of select_pairs."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from snakesfm.config.base import StageOptions

MANY_IMAGES = 500
# previewing a pair takes half a millisecond, matching it fifteen
MANY_IMAGES_TO_LOOK_AT = 1_000
SHORTLIST = 100


class SelectPairsOptions(StageOptions):
    """Which pairs of images are matched."""

    stage_version: ClassVar[int] = 7

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
    """All pairs, neighbours by name, similar images, neighbours by GPS (by name where an image has none),
    or your list; 'auto' takes your list, else all pairs of up to exhaustive_up_to images, else
    sequential+retrieval."""

    exhaustive_up_to: Annotated[int, Field(ge=2, le=100_000)] | Literal["auto"] = "auto"
    """Number of images up to which 'auto' takes all pairs; 'auto' is 1000 if pairs are previewed with
    their largest keypoints, otherwise 500."""

    look_ahead: int = Field(10, ge=1, le=10_000)
    """Number of following images, in natural order of names, with which 'sequential' pairs an image."""

    top_k: Annotated[int, Field(ge=1, le=100_000)] | Literal["auto"] = "auto"
    """Candidate partners proposed per image; 'auto' is 100 if candidates are previewed, otherwise 15
    (30 from 500 images on). With 'sequential+retrieval', half of them are rather images that are more
    similar than their look_ahead neighbours by name."""

    min_score: float = Field(-1.0, ge=-1.0, le=1.0)
    """Smallest similarity of a pair proposed by 'retrieval'; -1 leaves out none."""

    preview_keypoints: int = Field(400, ge=0, le=10_000)
    """Number of largest SIFT keypoints per image with which proposed pairs are previewed before
    matching; 0 turns the preview off. Only with SIFT, and not for 'sequential' and 'listed'."""

    min_likeness: float = Field(1.5, ge=0.0)
    """Smallest likeness (preview score) of a pair that is matched; higher values leave out more pairs."""

    least_partners: int = Field(16, ge=0, le=10_000)
    """Partners kept per image however small their likeness, the most similar first."""

    enough_partners: int = Field(30, ge=0, le=10_000)
    """Partners kept per image (0 keeps all): half of them are the most similar ones, the others are every
    second one of the next most similar."""

    enough_likeness: float = Field(250.0, ge=0.0)
    """An image with weakly similar partners keeps more of them, until their likeness sums to this."""

    def resolve(self, image_count: int, pairs_file: str = "", detector: str = "sift") -> Self:
        """The options with every 'auto' replaced by what it means for a number of images.

        Parameters
        ----------
        image_count : number of images of the scene.
        pairs_file : path of the user's list of pairs, or "" for none; 'auto' follows a list that is given.
        detector : whose keypoints there are before pairs are chosen, or "" for none. Only SIFT's are used
            for previews: others have no scales, and how well their descriptors serve was never measured.
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
        """Whether pairs are previewed before they are chosen, once the options are resolved."""
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
        """How many of the proposed pairs the preview keeps, at most if links are not weak."""
        limited = self.looks_at_pairs and self.enough_partners > 0
        return min(images * self.enough_partners, proposed) if limited else proposed
