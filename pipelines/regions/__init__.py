"""Labels of what each pixel of a peak frame shows, and the head's own matte without the torso."""

from pipelines.regions.stage import STAGE

__all__ = ["STAGE"]
