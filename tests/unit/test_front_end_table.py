"""The table of front-ends says what was measured, and what was not."""

from benchmarks.front_ends import COMPARED, DEGREES, render


def value(area: float) -> dict:
    areas = {f"pose_auc_{degrees}deg": area for degrees in DEGREES}
    return {"reference_images": 5, "reference_images_registered": 4, "cpu_seconds": 12.4, **areas}


def test_rows_means_failures_and_gaps() -> None:
    values = {
        "a|sift": value(80.0),
        "a|disk+lightglue": value(70.0),
        "b|sift": value(60.0),
        "b|disk+lightglue": {"failure": "no memory"},
    }
    text = render(values, ["a", "b"], ["sift", "disk+lightglue"])
    assert "| sift | 80.0 | 80.0 | 80.0 | 80.0 | 80.0 | 4 of 5 | 12 |" in text
    assert "| disk+lightglue | no memory |" in text
    # only set a was finished by both
    assert "## Mean of 1 sets" in text and text.count("| sift | 80.0") == 2
    assert "not run" in render({}, ["a"], ["sift"])


def test_the_oracle_is_not_compared() -> None:
    assert "virtual" not in COMPARED and {"sift", "aliked+lightglue"} <= set(COMPARED)
