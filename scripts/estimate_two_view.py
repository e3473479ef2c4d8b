from snakesfm.job import run_job

run_job("estimate_two_view")
