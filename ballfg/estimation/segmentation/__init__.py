"""The segmentation finds contacts, hits, rests and bad samples of one track before its estimation.

`segment` explains a whole track; `Segmenter` does it sample by sample. The model and its numbers are in
docs/derivations/segmentation.md.
"""
