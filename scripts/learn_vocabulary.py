from snakesfm.start import start_job

start_job("learn_vocabulary")
