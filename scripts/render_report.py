from snakesfm.job import run_job

run_job("render_report")
