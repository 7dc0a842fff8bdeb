"""The sizes of networks that tests share: machine code is generated for each kind and size, in up to half a minute."""

SMALL = {"width_flight": 5, "width_contact": 5, "depth": 2}
"""Keys of `Architecture.of` and of a config's `architecture`."""
