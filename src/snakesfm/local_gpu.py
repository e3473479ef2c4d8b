"""One job at a time on the GPU of the machine that a run is on."""

import shutil
from typing import Any

DRIVER_TOOL = "nvidia-smi"


def limit_gpu_jobs(scheduler: Any) -> None:
    """Let jobs that use a GPU follow one another, unless the user says how many may run at once.

    Each would take the first device, whose memory seldom holds the networks of as many jobs as there are
    cores.

    Parameters
    ----------
    scheduler : Snakemake's (9.27), of a run on one machine, before it starts jobs.
    """
    if "gpu" not in scheduler.global_resources and shutil.which(DRIVER_TOOL):
        scheduler.global_resources["gpu"] = scheduler.resources["gpu"] = 1
