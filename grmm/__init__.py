"""GRMM is a Gaussian residual morphable head model, trained on packed shards.

Where to find the paper's parts (docs/PAPER.md has every equation, docs/GRMM.md the choices):

- the model: `model` runs it; `networks` has the decoders, `anchors` ties Gaussians to the mesh,
  `rasterize` draws them
- training and losses: `train` is the loop, `losses` has the terms, `config` the settings
- fitting via inverse rendering, and the measures of a fit: `fit`
- experiments: `evaluate`, `ablate`, `study`
- data: `shard_source` reads shards, `data` turns them into tensors
- a trained model in use: `checkpoint`, `edit`, `render`, `viewer`, `export`, `player`
"""
