"""This room reads and writes files: text, arrays, pictures, video, checkpoints."""
