# The weights of the learned methods. Nothing depends on this rule: it runs where it is asked for by name.


localrules:
    fetch_weights,


rule fetch_weights:
    params:
        python=sys.executable,
        folder=str(PLAN.weights),
        models=PLAN.models,
    shell:
        "{params.python:q} -m snakesfm.learned.fetch {params.folder:q} {params.models:q}"
