"""The cubic step with level ends, as shading languages have it."""

from __future__ import annotations

import numpy as np


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Step smoothly from 0 at ``low`` to 1 at ``high``; ``low`` may exceed ``high``."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
