"""The averagers by name."""

from snakesfm.rotation_averaging.base import RotationAverager


def make_averager(method: str) -> RotationAverager:
    """An averager with its defaults: ``two_stage``, ``irls`` or ``shonan``.

    Raises
    ------
    ValueError : there is no averager of that name.
    """
    if method == "two_stage":
        from snakesfm.rotation_averaging.two_stage import TwoStageAverager

        return TwoStageAverager()
    if method == "irls":
        from snakesfm.rotation_averaging.irls import IrlsAverager

        return IrlsAverager()
    if method == "shonan":
        from snakesfm.rotation_averaging.shonan import ShonanAverager

        return ShonanAverager()
    raise ValueError(f"there is no rotation averager '{method}': use two_stage, irls or shonan")
