from snakesfm.start import start_job

start_job("extract_features")
