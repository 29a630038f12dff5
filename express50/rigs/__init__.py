"""Rigs: cameras that other tools calibrated, read into ours, and checks that any rig must pass."""
