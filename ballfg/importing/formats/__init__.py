"""Files, folders and data in memory to tables, nothing interpreted yet."""
