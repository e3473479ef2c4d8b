"""The images of an index, read as they were when they were indexed."""

from pathlib import Path
from typing import TYPE_CHECKING

from snakesfm.artifacts.images import ImageIndex
from snakesfm.errors import ImageError
from snakesfm.ingest.read import ImagePixels, read_image

if TYPE_CHECKING:
    from snakesfm.stages.job import StageJob


class IndexedImages:
    """Reads the images of an index, and keeps count of those that cannot be decoded.

    Parameters
    ----------
    index : which images there are, with the SHA-256 of their files.
    folder : the image folder.
    """

    def __init__(self, index: ImageIndex, folder: Path) -> None:
        self._index = index
        self._folder = folder
        self._damaged: dict[int, str] = {}

    def read(self, row: int, shorter_side_px: int | None = None) -> ImagePixels | None:
        """The pixels of an image, or None with a warning in the log where they cannot be decoded.

        Parameters
        ----------
        row : of the index.
        shorter_side_px : as in :func:`snakesfm.ingest.read.read_image`.

        Raises
        ------
        SceneError : the file cannot be read now, or is another than when it was indexed.
        """
        path = self._folder / str(self._index.names[row])
        try:
            return read_image(path, shorter_side_px, str(self._index.sha256[row]))
        except ImageError as error:
            if row not in self._damaged:
                print(f"warning: {error}", flush=True)
            self._damaged[row] = str(error)
            return None

    def warn_of_damaged(self, job: "StageJob") -> None:
        """Tell the user of the images that could not be decoded."""
        if self._damaged:
            first = self._damaged[min(self._damaged)]
            job.warn(f"{len(self._damaged)} images cannot be decoded and are left out, first: {first}")
