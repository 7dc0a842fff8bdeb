"""Balls of which it is not certain whether they have bounced: what is known of them on either side of the contact."""
