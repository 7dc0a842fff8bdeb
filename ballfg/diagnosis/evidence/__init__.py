"""Evidence says how probable the tracks are under a model with its unexplained motion as noise."""
