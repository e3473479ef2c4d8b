from snakesfm.job import run_job

run_job("merge_keypoints")
