"""Effects on the impact and on the place of the surfaces."""
