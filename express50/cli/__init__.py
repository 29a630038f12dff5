"""This room holds the express50 command line."""
