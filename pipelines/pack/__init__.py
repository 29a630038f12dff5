"""Packing: cropped samples of every subject, expression and camera into checksummed shards."""

from pipelines.pack.stage import STAGE

__all__ = ["STAGE"]
