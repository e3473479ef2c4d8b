from snakesfm.start import start_job

start_job("adjust_bundle")
