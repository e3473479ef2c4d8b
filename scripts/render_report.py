from snakesfm.start import start_job

start_job("render_report")
