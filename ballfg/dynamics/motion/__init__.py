"""Moves a ball from one state to a later one: integration, contacts, rollouts."""
