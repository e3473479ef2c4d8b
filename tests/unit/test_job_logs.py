"""What a job's log says of its cost."""

from snakesfm.job_logs import clock, describe_cost, stage_costs


def test_costs_of_a_stages_jobs_are_joined() -> None:
    logs = [
        describe_cost("match_pairs", 10.0, 2.5, 2.0, 100.0),
        describe_cost("match_pairs", 11.0, 1.5, 1.0, 300.4),
        f"scene: 3 of 9 images\n{describe_cost('index_images', 1.0, 0.5, 0.4, 80.0)}\n",
    ]
    assert stage_costs(logs) == {"match_pairs": (4.0, 300.0), "index_images": (0.5, 80.0)}


def test_the_clock_has_three_digits_behind_the_seconds() -> None:
    assert [clock(seconds)[-6:] for seconds in (7.0, 7.0625, 7.5)] == ["07.000", "07.062", "07.500"]


def test_a_job_that_was_run_again_counts_with_its_last_run() -> None:
    runs = [describe_cost("build_tracks", float(k), 1.0 + k, 1.0, 100.0 + k) for k in range(3)]
    assert stage_costs(["\n".join(runs)]) == {"build_tracks": (3.0, 102.0)}


def test_a_job_that_did_not_end_has_no_cost() -> None:
    assert stage_costs(["2026-01-01T00:00:00.000 build_tracks out.h5\nerror: no\n", ""]) == {}
