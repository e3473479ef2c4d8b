from snakesfm.job import run_job

run_job("build_tracks")
