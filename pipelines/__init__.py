"""One module or small package a stage; they meet the other packages only in files."""
