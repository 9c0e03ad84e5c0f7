"""SqueezeNet v1.0 up to its last fire module (Iandola et al., 2016, table 1); its classifier is of no use here."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_FIRST_FIRE = 2  # the paper counts the first convolution as layer 1
_STEM_CHANNELS = 96
# (channels left by the squeeze, channels of each of the two expansions) of the fire modules, in order.
_FIRES = ((16, 64), (16, 64), (32, 128), (32, 128), (48, 192), (48, 192), (64, 256), (64, 256))
_POOLED_BEFORE = (2, 5, 9)  # fire modules behind a maximum of 3 x 3 at stride 2


class SqueezeNet(nn.Module):
    """Images [n, 3, height, width] to the maps behind some fire modules."""

    def __init__(self, output_fires: Sequence[int]) -> None:
        """Leave the parameters as torch makes them.

        Args:
            output_fires: Numbers of the fire modules whose maps are given, ascending, 2..9; none behind is computed.
        """
        super().__init__()
        self._output_fires = tuple(output_fires)
        self.stem = nn.Conv2d(3, _STEM_CHANNELS, 7, stride=2)
        self.fires = nn.ModuleDict()
        n_inputs = _STEM_CHANNELS
        for number, (n_squeezed, n_expanded) in enumerate(
            _FIRES[: self._output_fires[-1] - _FIRST_FIRE + 1], _FIRST_FIRE
        ):
            self.fires[str(number)] = _Fire(n_inputs, n_squeezed, n_expanded)
            n_inputs = 2 * n_expanded

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps [n, channels, rows, columns], by `output_fires`; at stride 4 (fires 2..4), 8 (5..8) or 16 (9)."""
        features = functional.relu(self.stem(images))
        maps = []
        for number, fire in self.fires.items():
            if int(number) in _POOLED_BEFORE:
                # Windows may hang over the edge, as in Caffe, which made the weights: torchvision does the same.
                features = functional.max_pool2d(features, 3, 2, ceil_mode=True)
            features = fire(features)
            if int(number) in self._output_fires:
                maps.append(features)
        return maps


class _Fire(nn.Module):
    """Few channels, then many: half of these see a point, half its neighbourhood (section 3.2)."""

    def __init__(self, n_inputs: int, n_squeezed: int, n_expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(n_inputs, n_squeezed, 1)
        self.expand_1x1 = nn.Conv2d(n_squeezed, n_expanded, 1)
        self.expand_3x3 = nn.Conv2d(n_squeezed, n_expanded, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        squeezed = functional.relu(self.squeeze(features))
        return functional.relu(torch.cat([self.expand_1x1(squeezed), self.expand_3x3(squeezed)], dim=1))
