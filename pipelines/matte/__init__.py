"""Mattes of peak frames by keying against the camera's clean plate."""

from pipelines.matte.stage import STAGE

__all__ = ["STAGE"]
