"""Smooths long tracks piece by piece and joins the pieces to the whole track's minimum."""
