"""Each stage is a small package here; stages meet the other packages only in files."""
