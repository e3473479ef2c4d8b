from snakesfm.start import start_job

start_job("triangulate_tracks")
