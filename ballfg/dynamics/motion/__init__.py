"""How a ball gets from one state to a later one: integration, contacts, rollouts."""
