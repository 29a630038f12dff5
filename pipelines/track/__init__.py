"""Tracking: a head model is fitted to every peak frame of a subject, seen by all its cameras."""

from pipelines.track.stage import STAGE

__all__ = ["STAGE"]
