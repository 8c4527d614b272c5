"""Fits of a whole sample library: a manifest, one job for each key, and workers on this machine or on a cluster."""

from .dask_pool import Cluster, check_cluster
from .job import Job, Settings, make_unit
from .manifest import Key, Sample, read_keys
from .process_pool import Local
from .run import Progress, plan_jobs, run_batch
from .state import status
from .survey import Unread, listing, mixtures, unread

__all__ = [
    "Key", "Sample", "read_keys",
    "Settings", "Job", "make_unit", "Unread", "listing", "mixtures", "unread",
    "Local", "Cluster", "check_cluster", "Progress", "plan_jobs", "run_batch", "status",
]  # fmt: skip
