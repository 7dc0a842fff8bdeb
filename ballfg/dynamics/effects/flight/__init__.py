"""Effects on the flight, one a file."""
