"""The errors a user sees: one line each, saying where, what, got, expected and how to mend."""

from __future__ import annotations


class Express50Error(Exception):
    """Base of every error that the command line turns into one line and exit code 1."""


class CaptureError(Express50Error):
    """A raw capture is missing a file, or holds one that cannot be read."""


class CalibrationError(Express50Error):
    """Cameras are missing, malformed or do not fit their footage."""


class ConfigError(Express50Error):
    """A configuration key or value is unknown or out of range."""


class FormatError(Express50Error):
    """A file does not follow its format."""


class StageError(Express50Error):
    """A stage cannot process one of its items."""


class AnnotationError(Express50Error):
    """A label is invalid or contradicts the footage."""


class HeadModelError(Express50Error):
    """A head model file is malformed, unsafe or unsupported."""


class TrainError(Express50Error):
    """Training or fitting cannot go on."""
