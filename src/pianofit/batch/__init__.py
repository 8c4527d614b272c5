"""A sample library as one batch: a manifest, a ledger, and workers on this machine or on a cluster."""

from .cluster import Cluster, check_cluster
from .local import Local
from .manifest import Key, Sample, read_keys
from .run import Progress, plan, run_batch
from .state import status
from .survey import Unread, listing, mixtures, unread
from .units import Settings, Unit, make_unit

__all__ = [
    "Key", "Sample", "read_keys",
    "Settings", "Unit", "make_unit", "Unread", "listing", "mixtures", "unread",
    "Local", "Cluster", "check_cluster", "Progress", "plan", "run_batch", "status",
]  # fmt: skip
