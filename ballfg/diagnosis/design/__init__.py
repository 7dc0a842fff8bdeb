"""The shots that tell most: predicted flights, their information, and a choice among them."""
