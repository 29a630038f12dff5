"""Raw captures: index, frames, calibration, expressions."""
