"""Associates the candidates of several cameras to balls in space."""
