"""The last samples of a stream as a factor graph: what a window predicts and holds, and two ways to solve it."""
