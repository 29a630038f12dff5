"""The terminal annotator: state, frames, pictures and the Textual app."""
