"""Calibration of a rig: given cameras are checked, others are solved from ChArUco images."""

from pipelines.calibrate.stage import STAGE

__all__ = ["STAGE"]
