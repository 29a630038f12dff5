"""The generator of the built-in head model; only its stored arrays are read at run time."""
