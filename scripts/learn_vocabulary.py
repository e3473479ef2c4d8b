from snakesfm.job import run_job

run_job("learn_vocabulary")
