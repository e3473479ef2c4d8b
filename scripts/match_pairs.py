from snakesfm.job import run_job

run_job("match_pairs")
