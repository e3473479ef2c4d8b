# The weights of the learned methods. Nothing depends on this rule: it runs only if it is requested by name.


localrules:
    fetch_weights,


rule fetch_weights:
    log:
        ".snakemake/log/fetch_weights.log",
    params:
        python=sys.executable,
        folder=str(PLAN.weights),
        models=PLAN.models,
    shell:
        "{params.python:q} -m snakesfm.learned.fetch {params.folder:q} {params.models:q} 2>&1 | tee {log:q}"
