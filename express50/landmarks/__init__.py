"""This room finds 68 landmarks: network, detection in frames, synthetic training."""

from pathlib import Path

WEIGHTS = Path(__file__).with_name("weights.npz")  # of the network, whose module imports torch
