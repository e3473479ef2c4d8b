from snakesfm.start import start_job

start_job("index_matches")
