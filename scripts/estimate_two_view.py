from snakesfm.start import start_job

start_job("estimate_two_view")
