"""EXPRESS-50 is the core of the head capture toolkit: files, stages, cameras, heads."""

__version__ = "0.1.0"
