"""What is left after the search: patterns, drift, and fallbacks without a name."""
