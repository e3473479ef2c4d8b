# Names, input functions and the start and end of a run. No rules here.

import json
import re
import shlex
import sys

from snakemake.exceptions import WorkflowError
from snakemake.settings.types import DeploymentMethod, Quietness

from snakesfm import resources, rule_inputs, slurm
from snakesfm.errors import SnakesfmError
from snakesfm.blocks import tile_names
from snakesfm.config.configuration import SCENE_PATTERN, check_spelling
from snakesfm.config_checks import check_given_once, check_keys
from snakesfm.job_server import JobServer
from snakesfm.local_gpu import limit_gpu_jobs
from snakesfm.model_files import MODEL_FILES
from snakesfm.plan import Plan
from snakesfm.records import (
    check_backend,
    check_folder,
    deletes,
    makes_nothing,
    split_words,
)
from snakesfm.rule_settings import check_named_together, share_resources
from snakesfm.run import IMAGE_COUNTS, Run
from snakesfm.scene_checks import check_results
from snakesfm.scene_plan import ScenePlan
from snakesfm.termination import answer_interrupt, answer_term_aside


def refusal(error):
    """The error as one of Snakemake's; '--quiet all' would hide it, so it is printed here in that case."""
    if Quietness.ALL in (workflow.output_settings.quiet or ()):
        sys.stderr.write(f"snakesfm: {error}\n")
    return WorkflowError(str(error))


try:
    # Snakemake knows its targets only later, and this one needs no images
    words = split_words(sys.argv[1:])
    asked = {word.split(":")[0] for word in words}
    if workflow.is_main_process:
        check_folder(workflow.main_snakefile)
        check_backend(workflow.workflow_settings.persistence_backend.item_to_choice())
        check_given_once(sys.argv[1:])
        check_keys(workflow.overwrite_configfiles)
    check_spelling(config, sys.argv[1:])
    # jobs are told how many images there were when the run was planned
    counted = {} if workflow.is_main_process else config.pop(IMAGE_COUNTS, {})
    PLAN = Plan(config, "fetch_weights" in asked, counted)
    if workflow.is_main_process:
        check_named_together(words, "select_pairs", PLAN.select_pairs_twins())
        for planned in PLAN.scenes.values():
            check_results(planned)
    RUN = Run(PLAN)
    if workflow.is_main_process and not makes_nothing(sys.argv[1:]):
        RUN.refuse_unrecorded(asked)
    if workflow.is_main_process and deletes(sys.argv[1:]):
        RUN.keep_others_away()
except SnakesfmError as error:
    raise refusal(error) from None

JOB_SERVER = JobServer()
IN_CONTAINER = (
    DeploymentMethod.APPTAINER in workflow.deployment_settings.deployment_method
)
# a stage with more outputs names them itself, because Snakemake keeps the command with each of them
MOST_LISTED_OUTPUTS = 16
# freed images stay with the process, in huge pages: glibc would give them back, and each page is cleared anew
MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "1073741824",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}


wildcard_constraints:
    scene=SCENE_PATTERN,
    block=r"\d+",
    tile=r"\d+-\d+",


def artifact(stage, file):
    """The pattern of a stage's file in every scene."""
    return str(PLAN.output / "{scene}" / stage / file)


def log_file(stage, part="job"):
    """The pattern of a job's log."""
    return str(PLAN.output / "{scene}" / "logs" / stage / f"{part}.log")


def files_of(stage, parts):
    """An input function: a stage's files for 'blocks' or 'tiles', all of the scene's."""

    def list_files(wildcards):
        return PLAN.scenes[wildcards.scene].files(stage, parts)

    return list_files


def of_scene(choose, *parts):
    """An input function: what 'choose' gives for a scene and, where asked for, a job's block or tile."""

    def list_files(wildcards):
        scene = PLAN.scenes[wildcards.scene]
        return choose(scene, *(wildcards[part] for part in parts))

    return list_files


def any_of(names):
    """A wildcard constraint that matches just these names."""
    return "|".join(re.escape(name) for name in names)


def job_params(stage):
    """A params function: the canonical JSON of all that determines a job's result beside its inputs."""

    # of wildcards alone: Snakemake does not track a params function that takes more
    def render(wildcards):
        scene = PLAN.scenes[wildcards.scene]
        return scene.params(stage, wildcards, workflow.is_main_process)

    return render


def gpus(stage):
    """A resource function: the GPUs that a job of a stage makes use of."""

    def count(wildcards):
        return PLAN.scenes[wildcards.scene].gpus(stage)

    return count


def job_files():
    """A params function: the JSON of a job's scene and files, and of what no result depends on.

    Snakemake tracks it by the files alone.
    """

    def render(wildcards, input, output):
        scene = PLAN.scenes[wildcards.scene]
        call = {
            "scene": wildcards.scene,
            "inputs": {
                name: value if isinstance(value, str) else list(value)
                for name, value in input.items()
            },
            "outputs": list(output)[:MOST_LISTED_OUTPUTS],
            "upstream": scene.upstream(input),
            "batch_size": scene.configuration.batch_size,
        }
        return json.dumps(call)

    return render


def job_command(stage):
    """The shell command of a job: its script, which reads from standard input what it needs to know.

    A here-document is no argument, so it holds any number of files, and its quoted mark keeps the shell from
    changing a character of it.
    """
    python = "python" if IN_CONTAINER else shlex.quote(sys.executable)
    script = shlex.quote(f"{workflow.basedir}/scripts/{stage}.py")
    malloc = " ".join(f"{name}={value}" for name, value in MALLOC.items())
    command = f"{malloc} exec {python} {script}".replace("{", "{{").replace("}", "}}")
    return f"{command} <<'END OF JOB'\n{{params.job}}\n{{params.files}}\n{{threads}}\n{{log}}\nEND OF JOB\n"


def undistorting_threads(wildcards):
    """The threads of export_model, which works on many images only where it undistorts them."""
    scene = PLAN.scenes[wildcards.scene]
    return resources.UNDISTORTING_THREADS if scene.undistorts else 1


def memory_mb(stage):
    """A resource function: the memory that a job asks a cluster for."""
    return asking(resources.memory_mb, stage)


def runtime_min(stage):
    """A resource function: the minutes that a job asks a cluster for."""

    def need(stage, load, attempt):
        # Snakemake knows them only when it has read the Snakefile
        groups = workflow.group_settings.overwrite_groups
        start = resources.start_min(stage, groups)
        return resources.runtime_min(stage, load, attempt, start)

    return asking(need, stage)


def asking(need, stage):
    """A resource function of what a stage's job works on, with how many threads, and of the attempt."""

    def compute(wildcards, attempt, threads):
        # only the controller submits jobs, so only it needs the number of images
        if not workflow.is_main_process:
            return 1
        load = PLAN.scenes[wildcards.scene].load(stage, threads)
        return need(stage, load, attempt)

    return compute


def all_files():
    """What a run makes of all scenes."""
    return [path for scene in PLAN.scenes.values() for path in scene.all_files()]


def all_databases():
    """The COLMAP databases of all scenes."""
    return [scene.database_file() for scene in PLAN.scenes.values()]


def all_hloc_files():
    """Features and matches of all scenes in hloc's files."""
    return [path for scene in PLAN.scenes.values() for path in scene.hloc_files()]


def rules_by_scene(jobs):
    """Per scene the names of the rules of these jobs."""
    found = {}
    for job in jobs:
        if "scene" in job.wildcards.keys():
            found.setdefault(job.wildcards.scene, set()).add(job.rule.name)
    return found


def start_run():
    """Lock the output folder for this run, and say what is about to be done."""
    answer_term_aside(workflow.scheduler)
    answer_interrupt(RUN.note_interrupt)
    executor = getattr(workflow.scheduler, "_executor", None)
    # the SLURM executor names all jobs of a run alike
    slurm_run = getattr(executor, "run_uuid", "")
    if slurm_run:
        slurm.steady(executor)
    try:
        RUN.start(slurm_run)
        RUN.keep_configuration(workflow)
    except SnakesfmError as error:
        raise refusal(error) from None
    if workflow.local_exec:
        limit_gpu_jobs(workflow.scheduler)
        if not workflow.deployment_settings.deployment_method:
            JOB_SERVER.start(MALLOC)


def finish_run(log):
    """One line per scene about its model."""
    JOB_SERVER.stop()
    RUN.finish(rules_by_scene(workflow.dag.jobs))


def fail_run(log):
    """One line per scene that ended well, and one per error."""
    JOB_SERVER.stop()
    unfinished = rules_by_scene(workflow.dag.needrun_jobs()).keys()
    RUN.fail(rules_by_scene(workflow.dag.jobs), unfinished, workflow.local_exec)
