"""Read, write and edit packed shards."""
