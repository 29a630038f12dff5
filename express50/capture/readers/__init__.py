"""Read captures in other datasets' layouts in place, with one module per layout."""
