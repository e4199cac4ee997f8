"""Which pixels of a mask count in votes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VoteConfig:
    """Which pixels of a mask count.

    Within ``border_px`` of another mask or of the mask's edge the owner of a pixel is uncertain,
    unless the depth decides: where all surface within ``edge_px`` at the landmark's depth, to the
    relative tolerance ``edge_depth``, belongs to instances of one class. A depth belongs to the
    mask's surface if it differs from the median depth in the mask by at most ``depth_sigmas``
    robust standard deviations plus ``depth_margin_m`` at 1 m, which grows with the square of the
    depth. Landmarks farther than ``background_border_px`` from any mask are missed. Where neither
    distance nor depth decides, a pixel votes for its owner, or as missed, with ``border_weight``
    times the usual weight.

    A mask of which the share ``nested`` lies in another of at least twice its area and of another
    class is in front of it, whatever the scores: a book in a bookcase.
    """

    border_px: int = 1
    depth_sigmas: float = 3.5
    depth_margin_m: float = 0.03
    edge_px: int = 4
    edge_depth: float = 0.03
    background_border_px: int = 8
    border_weight: float = 0.6
    nested: float = 0.8

    def __post_init__(self) -> None:
        if (
            min(self.border_px, self.edge_px, self.background_border_px) < 0
            or self.depth_sigmas <= 0
            or min(self.depth_margin_m, self.edge_depth) < 0
        ):
            raise ValueError("borders and depth tolerances must not be negative")
        if not 0 <= self.border_weight <= 1 or self.nested <= 0:
            raise ValueError("border_weight must be in [0, 1], nested above 0")
