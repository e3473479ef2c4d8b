from snakesfm.job import run_job

run_job("extract_features")
