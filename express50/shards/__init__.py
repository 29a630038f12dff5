"""Packed shards: reading, writing, editing."""
