"""GRMM is a Gaussian residual morphable head model, trained on packed shards."""
