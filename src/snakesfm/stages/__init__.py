"""One module per stage: ``run(job)`` reads artifacts, calls pure functions and writes one artifact."""
