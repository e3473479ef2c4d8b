from snakesfm.job import run_job

run_job("select_pairs")
