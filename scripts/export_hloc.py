from snakesfm.job import run_job

run_job("export_hloc")
