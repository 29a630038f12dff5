"""Read and write files: text, arrays, pictures, video, checkpoints."""
