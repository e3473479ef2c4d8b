from snakesfm.job import run_job

run_job("calibrate_cameras")
