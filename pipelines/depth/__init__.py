"""Depth of one expression: a signed distance grid from mattes and photographs, seen per view."""

from pipelines.depth.stage import STAGE

__all__ = ["STAGE"]
