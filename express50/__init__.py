"""EXPRESS-50 is the core of the head capture toolkit: files, stages, cameras, heads."""

import sys
from types import ModuleType

__version__ = "0.1.0"

# Open3D's plots import a web server and IPython, half of the 0.5 core seconds that it takes to
# load. Nothing here plots with it, so a module without plots stands in for them.
_plots = ModuleType("open3d.visualization.draw_plotly")
for _name in ("get_plotly_fig", "draw_plotly", "draw_plotly_server"):
    setattr(_plots, _name, None)
sys.modules.setdefault(_plots.__name__, _plots)
