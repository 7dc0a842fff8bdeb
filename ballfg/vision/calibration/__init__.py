"""Calibrates lens and pose of cameras, from images of a board and from points of known place."""
