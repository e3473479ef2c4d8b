from snakesfm.job import run_job

run_job("evaluate_model")
