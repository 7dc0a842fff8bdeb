"""Long tracks: smoothed piece by piece, joined to the minimum of the whole track; docs/derivations/long_tracks.md."""
