"""Writes a diagnosis as files and pictures."""
