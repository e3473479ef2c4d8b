from snakesfm.start import start_job

start_job("merge_keypoints")
