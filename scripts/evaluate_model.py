from snakesfm.start import start_job

start_job("evaluate_model")
