"""A diagnosis as files and pictures."""
