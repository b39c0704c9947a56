"""Orchestration: plans, Dask, Prefect, and the command line."""

from .caches import keep_kernels

# Workers come in here too, before they load any kernel.
keep_kernels()
