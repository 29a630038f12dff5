"""A user study as the paper's: two methods side by side, two questions, five answers."""
