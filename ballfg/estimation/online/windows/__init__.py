"""A window is a factor graph of a stream's last samples, solved by iSAM2 or as a chain of triangles."""
