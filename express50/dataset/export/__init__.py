"""Tracked heads in the layouts of other tools: GaussianAvatars, OBJ, PLY, GLB."""
