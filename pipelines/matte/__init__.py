"""Mattes of peak frames: by keying against a clean plate, or by the user's own network."""

from pipelines.matte.stage import STAGE

__all__ = ["STAGE"]
