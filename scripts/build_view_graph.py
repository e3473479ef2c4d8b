from snakesfm.job import run_job

run_job("build_view_graph")
