from snakesfm.start import start_job

start_job("filter_view_graph")
