"""Effects on the free ball."""
