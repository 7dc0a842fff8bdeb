"""ballfg: from noisy measurements of a flying, bouncing ball to states, predictions and knowledge."""
