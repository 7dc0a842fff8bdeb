"""Learned models: networks, Gram-Schmidt features, their files."""
