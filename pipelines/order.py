"""The order of the stages and the modules that hold them; imports none of them."""

STAGES = {
    "ingest": "pipelines.ingest",
    "calibrate": "pipelines.calibrate",
    "observe": "annotations.observe",
    "align": "annotations.align",
    "alpha": "pipelines.alpha",
    "matte": "pipelines.matte",
    "track": "pipelines.track",
    "depth": "pipelines.depth",
    "regions": "pipelines.regions",
    "pack": "pipelines.pack",
}

# Stages that a stage's own command runs first.
FIRST = {"align": ("observe",), "matte": ("alpha",)}
