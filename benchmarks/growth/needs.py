"""What a job of every stage needs: models of memory and time, from measurements with a margin."""

from dataclasses import dataclass

MARGIN = 2.0


@dataclass(frozen=True)
class Need:
    """Model of one stage's jobs: a constant, and coefficients of N, n, P and t.

    N images, n images per block, P pairs, t pairs per tile.

    Parameters
    ----------
    memory : the five coefficients in MB.
    minutes : the five coefficients in minutes.
    parallel : the stage is cut into jobs.
    """

    memory: tuple[float, float, float, float, float]
    minutes: tuple[float, float, float, float, float]
    parallel: bool = False

    def mb(self, images: int, blocks: int, pairs: int) -> float:
        """MB of a job."""
        return _value(self.memory, images, blocks, pairs)

    def time(self, images: int, blocks: int, pairs: int) -> float:
        """Minutes of a job."""
        return _value(self.minutes, images, blocks, pairs)

    @property
    def mb_text(self) -> str:
        """The model of memory in letters."""
        return _text(self.memory)

    @property
    def minutes_text(self) -> str:
        """The model of time in letters."""
        return _text(self.minutes)


def tile_pairs(pairs: int, blocks: int) -> float:
    """Pairs in a tile of two different blocks."""
    return 2.0 * pairs / blocks**2


def _value(coefficients: tuple[float, ...], images: int, blocks: int, pairs: int) -> float:
    amounts = (1.0, images, images / blocks, pairs, tile_pairs(pairs, blocks))
    return sum(c * amount for c, amount in zip(coefficients, amounts, strict=True))


def _text(coefficients: tuple[float, ...]) -> str:
    letters = ("", " N", " n", " P", " t")
    return " + ".join(f"{c:g}{letter}" for c, letter in zip(coefficients, letters, strict=True) if c)


NEEDS = {
    "index_images": Need((500, 0.02, 0, 0, 0), (10, 0.002, 0, 0, 0)),
    "extract_features": Need((1500, 0, 2.0, 0, 0), (10, 0, 0.03, 0, 0), parallel=True),
    "learn_vocabulary": Need((1000, 0.01, 0, 0, 0), (20, 0.001, 0, 0, 0)),
    "describe_images": Need((500, 0, 0.2, 0, 0), (10, 0, 0.005, 0, 0), parallel=True),
    "select_pairs": Need((500, 0.01, 1.0, 0.0005, 0), (15, 0.003, 0, 0, 0)),
    "match_pairs": Need((400, 0, 0.02, 0, 0.03), (10, 0, 0, 0, 0.002), parallel=True),
    "calibrate_cameras": Need((500, 0.1, 0, 0.0005, 0), (15, 0.002, 0, 0, 0)),
    "estimate_two_view": Need((500, 0, 0.2, 0, 0.03), (10, 0, 0, 0, 0.002), parallel=True),
    "build_view_graph": Need((300, 0.01, 0, 0.002, 0), (10, 0.001, 0, 0, 0)),
    "filter_view_graph": Need((800, 0.02, 0, 0.002, 0), (10, 0.002, 0, 0, 0)),
    "average_rotations": Need((600, 0.05, 0, 0.01, 0), (15, 0.004, 0, 0, 0)),
    "build_tracks": Need((400, 1.2, 0, 0.02, 0), (10, 0.003, 0, 0, 0)),
    "average_translations": Need((600, 1.6, 0, 0, 0), (15, 0.02, 0, 0, 0)),
    "triangulate_tracks": Need((600, 1.6, 0, 0, 0), (10, 0.004, 0, 0, 0)),
    "adjust_bundle": Need((800, 4.5, 0, 0.01, 0), (20, 0.04, 0, 0, 0)),
    "export_model": Need((600, 1.6, 0, 0, 0), (10, 0.003, 0, 0, 0)),
    "export_database": Need((600, 0.1, 3.0, 0.001, 0), (10, 0.005, 0, 0, 0)),
    "export_hloc": Need((600, 0.1, 3.0, 0.001, 0), (10, 0.005, 0, 0, 0)),
    "evaluate_model": Need((800, 0.2, 0, 0, 0), (10, 0.001, 0, 0, 0)),
    "render_report": Need((600, 0.5, 0, 0, 0), (10, 0.001, 0, 0, 0)),
}
