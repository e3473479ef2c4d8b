from snakesfm.job import run_job

run_job("adjust_bundle")
