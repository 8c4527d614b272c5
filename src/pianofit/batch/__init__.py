"""Fits of a whole sample library: a manifest, one job for each key, and workers on this machine or on a cluster."""

from .dask_pool import DaskPool, check_cluster
from .job import Job, Settings, layout_remarks, make_job, unused_files
from .manifest import Key, Sample, read_keys
from .process_pool import ProcessPool
from .records import Status, status
from .run import Progress, plan_jobs, run_batch
from .second_pass import plan_joint_jobs, run_joint_batch
