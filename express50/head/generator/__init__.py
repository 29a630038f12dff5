"""Make the built-in head; only its stored arrays are read at run time."""
