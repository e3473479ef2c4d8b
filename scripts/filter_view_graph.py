from snakesfm.job import run_job

run_job("filter_view_graph")
