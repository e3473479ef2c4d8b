from snakesfm.start import start_job

start_job("select_pairs")
