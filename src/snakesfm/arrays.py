"""The type of all arrays; the docstrings of those who take and return them give shapes and dtypes."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
