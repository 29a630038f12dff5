"""Peak-expression labels: the store, suggestions, and the align stage that joins them."""
