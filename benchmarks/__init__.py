"""Benchmarks: accuracy against truth and seconds side by side; each ends in one JSON object."""
