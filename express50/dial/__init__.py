"""The dial: measure what time buys on a dataset, choose settings for a budget, and keep to it."""
