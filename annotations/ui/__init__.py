"""This room holds the terminal annotator: state, frames, pictures and the Textual app."""
