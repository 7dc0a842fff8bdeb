"""The smoother: the factor graph of a track and its minimum."""
