"""Effects on the bounce, one a file."""
