"""EXPRESS-50: the core of the multi-view head capture toolkit (files, stages, cameras, heads)."""

__version__ = "0.1.0"
