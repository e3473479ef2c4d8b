from snakesfm.start import start_job

start_job("calibrate_cameras")
