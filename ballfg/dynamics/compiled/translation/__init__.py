"""From a function of torch to the source of machine code."""
