"""This room finds 68 landmarks: network, detection in frames, synthetic training."""
