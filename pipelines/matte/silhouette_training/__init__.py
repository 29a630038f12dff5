"""Trains the silhouette network on renders of the digital twin; not used by the stages."""
