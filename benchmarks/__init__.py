"""Benchmarks measure accuracy against truth beside seconds; each ends in one JSON object."""
