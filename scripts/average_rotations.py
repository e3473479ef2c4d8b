from snakesfm.start import start_job

start_job("average_rotations")
