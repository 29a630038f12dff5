"""The embedded 68-landmark detector: network, detection in frames, synthetic training."""
