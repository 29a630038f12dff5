"""Make the built-in head; at run time only its stored arrays are read."""
