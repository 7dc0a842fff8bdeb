"""Effects on what is written down."""
