"""Reads files, folders and data in memory as tables, without interpreting them."""
