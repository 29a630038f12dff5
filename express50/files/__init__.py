"""Reading and writing of files: text, arrays, pictures, video, checkpoints."""
