"""From a Snakemake job to a stage's ``run``: the log, the errors and the former file."""

import contextlib
import importlib
import json
import os
import resource
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snakesfm.atomic import atomic_path
from snakesfm.job_logs import clock, describe_cost

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Call:
    """What Snakemake tells a job.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    params : ``options``, ``stage_version``, ``settings`` and ``seed``.
    files : ``scene``, ``inputs`` by name, ``outputs``, ``upstream``: options digests of what is read, and
        ``batch_size``: how many images or pairs a network gets at once.
    threads : how many threads may be used.
    log : the job's log.
    """

    stage: str
    params: dict[str, Any]
    files: dict[str, Any]
    threads: int
    log: Path

    @classmethod
    def parse(cls, stage: str, text: str) -> "Call":
        """From the lines that the rule's command gives: params, files, threads, and the log's name."""
        params, files, threads, log = text.removesuffix("\n").split("\n", 3)
        return cls(stage, json.loads(params), json.loads(files), int(threads), Path(log))

    def input_paths(self) -> list[Path]:
        """All files that the job reads."""
        named = self.files["inputs"].values()
        return [Path(file) for files in named for file in ([files] if isinstance(files, str) else files)]


def run_job(stage: str) -> None:
    """Run one stage as the Snakemake job that standard input describes.

    Standard output and error of this process, C++ libraries included, go to the job's log; progress and the
    one sentence of an error go to the terminal too.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    """
    limit_library_threads()
    call = Call.parse(stage, sys.stdin.buffer.read().decode("utf-8"))
    terminal = _redirect_to_log(call.log)
    try:
        job = _bind(call, terminal)
        _check_inputs(call)
        module = importlib.import_module(f"snakesfm.stages.{stage}")
        started, before = time.time(), _processor_seconds()
        print(f"{clock(started)} {stage} {job.output}", flush=True)
        module.run(job)
        _keep_former(job, module)
        _share(job, module)
    except Exception as error:
        _fail(call, _damage_behind(call, error) or error, terminal)
    ended = time.time()
    cpu_seconds = _processor_seconds() - before
    print(describe_cost(stage, ended, ended - started, cpu_seconds, peak_mb()), flush=True)


def limit_library_threads() -> None:
    """Give libraries that are loaded after this one thread each: stages start the threads themselves."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"


def _processor_seconds() -> float:
    """Processor time of this process and of its children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def peak_mb() -> float:
    """Largest memory of this process so far; a fork starts with what it was forked from."""
    with contextlib.suppress(OSError), Path("/proc/self/status").open(encoding="utf-8") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    # where there is no /proc; it holds what Snakemake had when it started the job, too
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _redirect_to_log(path: Path) -> Any:
    """Send file descriptors 1 and 2 to the log; return a stream to the terminal."""
    path.parent.mkdir(parents=True, exist_ok=True)
    terminal = os.fdopen(os.dup(2), "w", buffering=1)
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)
    return terminal


def _bind(call: Call, terminal: Any) -> Any:
    """The StageJob of a Snakemake job."""
    from snakesfm.stages.job import JobOptions, StageJob

    params = call.params
    outputs = tuple(Path(path) for path in call.files["outputs"])
    former = former_path(outputs[0])
    return StageJob(
        stage=call.stage,
        scene=call.files["scene"],
        inputs=call.files["inputs"],
        outputs=outputs,
        options=JobOptions(params["options"], params["stage_version"]),
        settings=params["settings"],
        seed=params["seed"],
        threads=call.threads,
        former=former if former.is_file() else None,
        batch_size=call.files["batch_size"],
        terminal=terminal,
    )


def former_path(output: Path) -> Path:
    """Where the last complete version of an output is kept while Snakemake re-makes it."""
    return output.parent / ".former" / output.name


def _keep_former(job: Any, module: Any) -> None:
    """Hard-link the finished output of a stage that reuses unchanged parts of its former file."""
    if not getattr(module, "REUSES_FORMER", False):
        return
    former = former_path(job.output)
    try:
        with atomic_path(former) as temporary:
            temporary.unlink()
            temporary.hardlink_to(job.output)
    except OSError as error:
        print(f"warning: {former} could not be kept ({error}); a re-run will compute everything again.")


def _check_inputs(call: Call) -> None:
    """Refuse input files that are damaged or not of this scene and configuration."""
    from snakesfm.artifacts.checks import check_inputs

    check_inputs(call.input_paths(), call.files["scene"], call.files["upstream"])


def _share(job: Any, module: Any) -> None:
    """Give a finished output that other runs could take over to the folder they share, if there is one."""
    from snakesfm.cache import VARIABLE, cached_path, share

    if VARIABLE in os.environ and getattr(module, "REUSES_FORMER", False):
        import h5py

        with h5py.File(job.output, "r", locking=False) as file:
            cached = cached_path(job.stage, file["digests"].asstr()[()])
        if cached is not None:
            share(job.output, cached, replace=cached in job.distrusted)


def _damage_behind(call: Call, error: Exception) -> Exception | None:
    """What an input that cannot be read whole is called, if it may be why a job failed."""
    from snakesfm.artifacts.checks import check_content
    from snakesfm.errors import ArtifactError, SnakesfmError

    if isinstance(error, MemoryError) or (
        isinstance(error, SnakesfmError) and not isinstance(error, ArtifactError)
    ):
        return None
    try:
        check_content(call.input_paths())
    except ArtifactError as damage:
        return damage
    except Exception:
        # on a full disk, say, where nothing can be renamed
        return None
    return None


def _fail(call: Call, error: Exception, terminal: Any) -> None:
    """Say what went wrong, in the log and on the terminal, and end with exit status 1."""
    from snakesfm.errors import SnakesfmError, remedy_of

    if isinstance(error, SnakesfmError):
        sentence = str(error)
    elif isinstance(error, OSError) and error.errno:
        # h5py's errors have a number and a message of many lines
        where = error.filename or Path(call.files["outputs"][0]).parent
        sentence = f"{os.strerror(error.errno)} '{where}': {remedy_of(error.errno)}."
        _print_trace()
    elif isinstance(error, MemoryError):
        sentence = (
            "Not enough memory: use fewer jobs at once (--resources mem_mb=MB on one machine), give the "
            "job more mem_mb, or use more blocks."
        )
        _print_trace()
    elif type(error).__name__ == "OutOfMemoryError":
        sentence = "Not enough memory on the GPU: set batch_size=1, smaller images, or device=cpu."
        _print_trace()
    else:
        _print_trace()
        sentence = f"Unexpected {type(error).__name__}: {error}; see {call.log} for details."
    print(f"snakesfm: scene '{call.files['scene']}', {call.stage}: {sentence}", file=terminal, flush=True)
    with contextlib.suppress(OSError):
        print(f"error: {sentence}", flush=True)
    # a log on a full disk must not end the process in another way
    os._exit(1)


def _print_trace() -> None:
    with contextlib.suppress(OSError):
        traceback.print_exc()
