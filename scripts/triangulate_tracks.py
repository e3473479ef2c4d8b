from snakesfm.job import run_job

run_job("triangulate_tracks")
