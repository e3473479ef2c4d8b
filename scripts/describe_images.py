from snakesfm.job import run_job

run_job("describe_images")
