"""Fits of a whole sample library: a manifest, one job for each key, and workers on this machine or on a cluster."""

from .dask_pool import DaskPool, check_cluster
from .job import Job, Settings, make_job
from .manifest import Key, Sample, read_keys
from .process_pool import ProcessPool
from .run import Progress, plan_jobs, run_batch
from .state import status
from .survey import UnusedFile, layout_remarks, recording_rows, unused_files

__all__ = [
    "Key", "Sample", "read_keys",
    "Settings", "Job", "make_job", "UnusedFile", "recording_rows", "layout_remarks", "unused_files",
    "ProcessPool", "DaskPool", "check_cluster", "Progress", "plan_jobs", "run_batch", "status",
]  # fmt: skip
