"""Read raw captures: their frames, index and expressions."""
