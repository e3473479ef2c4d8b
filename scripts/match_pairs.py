from snakesfm.start import start_job

start_job("match_pairs")
