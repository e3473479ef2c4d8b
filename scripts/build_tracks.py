from snakesfm.start import start_job

start_job("build_tracks")
