"""Readers of other datasets' layouts, one module per layout, read captures where they lie."""
