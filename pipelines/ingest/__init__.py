"""Ingest: the frame index, proxies and a first look at sync, light and focus of a capture."""

from pipelines.ingest.config import IngestConfig
from pipelines.ingest.scan import time_gaps
from pipelines.ingest.stage import STAGE, account, inputs, items, register, usual_count

__all__ = [
    "STAGE",
    "IngestConfig",
    "account",
    "inputs",
    "items",
    "register",
    "time_gaps",
    "usual_count",
]
