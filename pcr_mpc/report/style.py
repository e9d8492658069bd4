"""One look for all pictures: colours that survive colour-blindness (Okabe and Ito), readable at README size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

from ..files import picture_metadata, replacing

matplotlib.use("Agg")

import matplotlib.pyplot as plt

__all__ = ["BLUE", "GREEN", "GREY", "ORANGE", "PURPLE", "RED", "RODS", "SKY", "plt", "save_figure"]

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#777777",
)  # fmt: skip
RODS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)

plt.rcParams.update(
    {
        "figure.dpi": 110,
        "savefig.bbox": "tight",
        "font.size": 10,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "lines.linewidth": 1.6,
    }
)


def save_figure(figure: Any, path: Path, *, tight: bool = True) -> None:
    """Write a picture, whole or not at all, with metadata by which it is known to be ours; and close it.

    Without ``tight`` it is as large as its layout has it, which saves drawing it twice.
    """
    path = Path(path)
    try:
        with replacing(path) as draft:
            figure.savefig(draft, bbox_inches="tight" if tight else None, metadata=picture_metadata(path))
    finally:
        plt.close(figure)
