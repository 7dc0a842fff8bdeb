"""The smoother builds the factor graph of a track and finds its minimum."""
