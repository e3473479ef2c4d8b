"""The model that is exported, evaluated and reported."""

import pytest
from finished_model import CAMERA, COUNT

from snakesfm.synthetic.problems import SyntheticProblem, make_problem


@pytest.fixture(scope="module")
def problem() -> SyntheticProblem:
    return make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=CAMERA)
