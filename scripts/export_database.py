from snakesfm.start import start_job

start_job("export_database")
