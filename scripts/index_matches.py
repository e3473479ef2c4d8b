from snakesfm.job import run_job

run_job("index_matches")
