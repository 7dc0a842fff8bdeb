"""Follows balls that may or may not have bounced, with a belief for either side of the contact."""
