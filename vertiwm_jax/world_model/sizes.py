"""How large the learned networks of the world models are, all in one place."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TransformerSize:
    """Of the Transformer specialist's network.

    layers, width, heads, hidden: as `networks.Transformer` has them.
    channels: numbers that each cell of the latents is reduced to.
    """

    layers: int
    width: int
    heads: int
    hidden: int
    channels: int


BASE = TransformerSize(layers=3, width=128, heads=4, hidden=256, channels=8)
"""The shipped default."""
PAPER = TransformerSize(layers=3, width=320, heads=10, hidden=1280, channels=16)
"""Half of the paper's 9,972,634 parameters of dynamics."""
