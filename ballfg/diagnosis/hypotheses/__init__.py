"""Hypotheses are the effects that a model may lack, with the traces that they would leave in the samples."""
