"""This room trains the landmark network on rendered heads."""
