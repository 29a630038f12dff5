"""This room reads cameras that other tools calibrated, and checks any rig."""
