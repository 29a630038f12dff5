"""Captures in other datasets' layouts, read where they lie: one module a layout."""
