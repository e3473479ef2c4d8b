"""The images of an index, read as they were when they were indexed."""

from pathlib import Path

from snakesfm.arrays import Array
from snakesfm.errors import ImageError
from snakesfm.ingest.read import ImagePixels, read_image


class IndexedImages:
    """Reads the images of an index, and notes those that cannot be decoded.

    Parameters
    ----------
    names : (N) str, images of the index, relative to the folder.
    sha256 : (N) str, of their files, hexadecimal.
    folder : the image folder.
    """

    def __init__(self, names: Array, sha256: Array, folder: str | Path) -> None:
        self._names, self._sha256, self._folder = names, sha256, Path(folder)
        self.damaged: dict[int, str] = {}
        """What is wrong with the images that could not be decoded, a sentence each, by row."""

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
        if row in self.damaged:
            return None
        path = self._folder / str(self._names[row])
        try:
            return read_image(path, shorter_side_px, str(self._sha256[row]))
        except ImageError as error:
            print(f"warning: {error}", flush=True)
            self.damaged[row] = str(error)
            return None
