"""Cameras, rigid transforms and conversions between conventions."""
