"""This room reads, writes and edits packed shards."""
