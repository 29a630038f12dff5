"""The express50 command line."""
