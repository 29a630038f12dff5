"""Load head models: one type for FLAME, ICT-FaceKit and the built-in head."""

BUILTIN_NAME = "procedural"  # as commands and tracks name it; other head models are named by path
