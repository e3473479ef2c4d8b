from snakesfm.job import run_job

run_job("average_rotations")
