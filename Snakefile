# snakesfm: a folder of photographs becomes a COLMAP model by global Structure-from-Motion.
#
#   snakemake --profile profiles/local --config images=PATH output=DIR

from snakemake.utils import min_version

from snakesfm.run import CONFIGURATION_NAME

min_version("9.27")


# a cluster's jobs are given all of the run's configuration in one file instead
if not any(file.name == CONFIGURATION_NAME for file in workflow.overwrite_configfiles):

    configfile: f"{workflow.basedir}/config.yaml"


# used with --software-deployment-method apptainer alone; built from workflow/envs/Dockerfile
container: "docker://snakesfm/snakesfm:0.1.0"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/features.smk"
include: "workflow/rules/matching.smk"
include: "workflow/rules/mapping.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/reporting.smk"
include: "workflow/rules/weights.smk"


localrules:
    all,
    databases,


rule all:
    default_target: True
    input:
        all_files(),


rule databases:
    input:
        all_databases(),


onstart:
    start_run()


onsuccess:
    finish_run(log)


onerror:
    fail_run(log)
