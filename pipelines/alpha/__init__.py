"""Opacity in peak frames, each camera by itself: keyed against its plate, or by a network."""

from pipelines.alpha.stage import STAGE

__all__ = ["STAGE"]
