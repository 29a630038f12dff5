"""Train the landmark network on rendered heads."""
