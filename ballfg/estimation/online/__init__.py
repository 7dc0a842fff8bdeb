"""The online estimator smooths the newest samples of a stream in a window, by iSAM2 or a chain."""
