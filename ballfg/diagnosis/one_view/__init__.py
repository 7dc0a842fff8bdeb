"""Finds effects that a model lacks from the pixels of one camera."""
