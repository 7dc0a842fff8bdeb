"""Registers the physical effects by name, those of the package and those of users."""
