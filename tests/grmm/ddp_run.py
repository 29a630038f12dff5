"""Two processes train one step: run by test_ddp.py under torchrun."""

import sys
from pathlib import Path

import torch

from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config

torch.set_num_threads(1)
settings = {"iterations": 2, "accumulate": 2}
train(EllipsoidSource(size=32), ellipsoid_head(), Path(sys.argv[1]), tiny_config(train=settings))
