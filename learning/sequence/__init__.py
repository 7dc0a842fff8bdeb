"""Sequence models map observations straight to the rest of a track: an LSTM and a conditional diffusion model."""
