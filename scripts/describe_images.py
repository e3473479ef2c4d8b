from snakesfm.start import start_job

start_job("describe_images")
