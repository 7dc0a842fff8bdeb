"""The online estimator: iSAM2 over a window of the newest samples."""
