"""Measure speed against accuracy on a dataset, choose settings for a budget, and keep to it."""
