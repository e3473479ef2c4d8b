from typing import TYPE_CHECKING

from snakesfm.job import run_job

if TYPE_CHECKING:
    from snakemake.iocontainers import snakemake

run_job("export_database", snakemake)
