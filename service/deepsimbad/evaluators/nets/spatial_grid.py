"""From the maps of a trunk to one encoding: what is where in the picture."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


class SpatialGrid(nn.Module):
    """Pixels [n, height, width, 3] uint8 BGR to [n, d] float32 of unit length.

    Every map of the trunk is averaged in a grid, and every cell made unit length by itself: a bright cell says no more
    than a dark one.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, trunk: nn.Module, cells: tuple[int, int], mean: Sequence[float], std: Sequence[float], *, is_rgb: bool
    ) -> None:
        """Compose.

        Args:
            trunk: Images [n, 3, height, width] to maps [n, channels, rows, columns].
            cells: Rows and columns of the grid.
            mean: Of the pixels 0..255, in the order of the channels that the trunk takes.
            std: Of the same pixels, in the same order.
            is_rgb: Whether it takes red first.
        """
        super().__init__()
        self.trunk, self._cells, self._is_rgb = trunk, cells, is_rgb
        self.register_buffer("mean", torch.tensor(mean).reshape(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).reshape(3, 1, 1), persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        images = pixels.permute(0, 3, 1, 2)
        if self._is_rgb:
            images = images.flip(1)
        images = (images.float() - self.mean) / self.std
        maps = self.trunk(images.to(next(self.trunk.parameters()).dtype))
        cells = [functional.adaptive_avg_pool2d(features.float(), self._cells) for features in maps]
        return functional.normalize(torch.cat([functional.normalize(cell, dim=1).flatten(1) for cell in cells], dim=1))
