"""Effects on what is written down, one a file."""
