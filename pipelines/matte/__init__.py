"""Mattes of a moment: what each camera keyed alone, corrected where the other cameras disagree."""

from pipelines.matte.stage import STAGE

__all__ = ["STAGE"]
