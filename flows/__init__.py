"""Orchestration: plans, Dask, Prefect, and the command line."""
