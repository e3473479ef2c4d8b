"""Options of select_pairs."""

from typing import ClassVar, Literal, Self

from pydantic import Field

from snakesfm.config.base import StageOptions

MANY_IMAGES = 500


class SelectPairsOptions(StageOptions):
    """Which pairs of images are matched."""

    stage_version: ClassVar[int] = 1

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

    exhaustive_up_to: int = Field(500, ge=2, le=100_000)
    """Number of images up to which 'auto' takes all pairs, and sequential+retrieval beyond."""

    look_ahead: int = Field(10, ge=1, le=10_000)
    """How many following images, in the natural order of names, an image is paired with by 'sequential'."""

    top_k: int | Literal["auto"] = "auto"
    """How many similar or near images an image is paired with; 'auto' is 15, and 30 from 500 images on."""

    min_score: float = Field(0.0, ge=-1.0, le=1.0)
    """Least similarity of a pair chosen by 'retrieval'."""

    def resolve(self, image_count: int, pairs_file: str = "") -> Self:
        """The options with every 'auto' replaced by what it means for a number of images.

        Parameters
        ----------
        image_count : number of images of the scene.
        pairs_file : path of the user's list of pairs, or "" for none; 'auto' follows a list that is given.
        """
        method = self.method
        if method == "auto":
            if pairs_file:
                method = "listed"
            else:
                method = "exhaustive" if image_count <= self.exhaustive_up_to else "sequential+retrieval"
        top_k = self.top_k
        if top_k == "auto":
            top_k = 30 if image_count >= MANY_IMAGES else 15
        return self.model_copy(update={"method": method, "top_k": top_k})

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
