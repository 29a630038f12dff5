"""Load head models: one type for FLAME, ICT-FaceKit and the built-in head."""
