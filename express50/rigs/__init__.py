"""Read cameras that other tools calibrated, and check any rig."""
