"""Detects candidates for balls in videos, frame by frame."""
