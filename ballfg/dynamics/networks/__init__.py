"""Learned models describe flight and bounce by networks of Gram-Schmidt features, kept in files of their own."""
