"""This room reads raw captures: their frames, index and expressions."""
