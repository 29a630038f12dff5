"""Head models: one type for FLAME, ICT-FaceKit and the built-in procedural head."""
