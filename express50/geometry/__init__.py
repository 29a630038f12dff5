"""This room holds cameras, rigid transforms and conversions between conventions."""
