"""Training of the landmark network on rendered heads."""
