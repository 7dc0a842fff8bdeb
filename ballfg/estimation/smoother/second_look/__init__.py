"""Looks again at what a first minimum may have missed: another spin, the other side of a contact, low hops."""
