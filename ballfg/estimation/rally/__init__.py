"""A rally seen by one camera: flights found among many candidates, strokes between hits, and the best sequence."""
