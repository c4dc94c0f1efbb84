"""Worker processes on one machine or many, by Ray: their number, resources and start. Ray is imported by `connect` only."""

from unrender.app.distributed.cluster.connection import Cluster, connect, load_ray
from unrender.app.distributed.cluster.tasks import Ended, Executor, InProcess, OnWorkers
from unrender.app.distributed.cluster.workers import Share, Workers, prepare_worker, share

__all__ = [
    "Cluster",
    "Ended",
    "Executor",
    "InProcess",
    "OnWorkers",
    "Share",
    "Workers",
    "connect",
    "load_ray",
    "prepare_worker",
    "share",
]
