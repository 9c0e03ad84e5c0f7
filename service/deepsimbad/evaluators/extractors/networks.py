"""The first blocks of two networks, and the grid that makes one encoding of their maps: what is where in the picture.

In plain torch: tensors in, tensors out. Nothing here reads files, resizes images or picks a device.
"""

from collections.abc import Iterator, Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

_EPSILON = 1e-3  # of batch normalisation, as it was trained
# (repeats, kernel, stride, expansion, channels) of the stages up to block 10.
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112))
_STEM_CHANNELS = 32
_PAIRS = (
    ("_conv_stem", "_bn0"), ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2"),
)  # fmt: skip

_FIRST_FIRE = 2  # the paper counts the first convolution as layer 1
_FIRE_STEM_CHANNELS = 96
# (channels left by the squeeze, channels of each of the two expansions) of the fire modules, in order.
_FIRES = ((16, 64), (16, 64), (32, 128), (32, 128), (48, 192), (48, 192), (64, 256), (64, 256))
_POOLED_BEFORE = (2, 5, 9)  # fire modules behind a maximum of 3 x 3 at stride 2


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
            std: Likewise.
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


class EfficientNetLite(nn.Module):
    """Images [n, 3, height, width] to the maps behind some blocks: its stem and first eleven ones (Tan and Le, 2019).

    The Lite variant has no squeeze-and-excitation, and ReLU6. Parameters bear the names of the published checkpoint.
    """

    def __init__(self, taken: Sequence[int]) -> None:
        """Leave the parameters as torch makes them.

        Args:
            taken: Numbers of the blocks whose maps are given, ascending, 0..10; none behind the last is computed.
        """
        super().__init__()
        self._taken = tuple(taken)
        self._conv_stem = _SameConv(3, _STEM_CHANNELS, 3, 2)
        self._bn0 = nn.BatchNorm2d(_STEM_CHANNELS, _EPSILON)
        self._blocks = nn.ModuleList(list(_blocks())[: self._taken[-1] + 1])

    def folded(self) -> Self:
        """With every batch normalisation folded into the convolution before it: the same maps, a quarter sooner."""
        for module in (self, *self._blocks):
            for conv, norm in _PAIRS:
                if isinstance(getattr(module, conv, None), nn.Conv2d):
                    setattr(module, conv, fuse_conv_bn_eval(getattr(module, conv), getattr(module, norm)))
                    setattr(module, norm, nn.Identity())
        return self

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps [n, channels, height / stride, width / stride], in the order of `taken`."""
        features = functional.relu6(self._bn0(self._conv_stem(images)))
        maps = []
        for number, block in enumerate(self._blocks):
            features = block(features)
            if number in self._taken:
                maps.append(features)
        return maps


def _blocks() -> Iterator["_Block"]:
    n_inputs = _STEM_CHANNELS
    for repeats, kernel, stride, expansion, n_outputs in _STAGES:
        for repeat in range(repeats):
            yield _Block(n_inputs, n_outputs, kernel, stride if repeat == 0 else 1, expansion)
            n_inputs = n_outputs


class _Block(nn.Module):
    """An inverted residual: expand, filter every channel by itself, project."""

    def __init__(self, n_inputs: int, n_outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        n_inner = n_inputs * expansion
        if expansion > 1:
            self._expand_conv = nn.Conv2d(n_inputs, n_inner, 1, bias=False)
            self._bn0 = nn.BatchNorm2d(n_inner, _EPSILON)
        self._depthwise_conv = _SameConv(n_inner, n_inner, kernel, stride, groups=n_inner)
        self._bn1 = nn.BatchNorm2d(n_inner, _EPSILON)
        self._project_conv = nn.Conv2d(n_inner, n_outputs, 1, bias=False)
        self._bn2 = nn.BatchNorm2d(n_outputs, _EPSILON)
        self._expands, self._adds = expansion > 1, stride == 1 and n_inputs == n_outputs

    def forward(self, features: Tensor) -> Tensor:
        inner = functional.relu6(self._bn0(self._expand_conv(features))) if self._expands else features
        inner = functional.relu6(self._bn1(self._depthwise_conv(inner)))
        outputs: Tensor = self._bn2(self._project_conv(inner))
        return features + outputs if self._adds else outputs


class _SameConv(nn.Conv2d):
    """A convolution padded as TensorFlow does, by whose framework the weights were made: more behind than before."""

    def __init__(self, n_inputs: int, n_outputs: int, kernel: int, stride: int, groups: int = 1) -> None:
        super().__init__(n_inputs, n_outputs, kernel, stride, groups=groups, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        padding = []
        for side, kernel, stride in zip(features.shape[:1:-1], self.kernel_size[::-1], self.stride[::-1], strict=True):
            total = max(0, (-(-side // stride) - 1) * stride + kernel - side)
            padding += [total // 2, total - total // 2]
        return super().forward(functional.pad(features, padding))


class SqueezeNet(nn.Module):
    """Images [n, 3, height, width] to the maps behind some fire modules of v1.0 (Iandola et al., 2016, table 1)."""

    def __init__(self, taken: Sequence[int]) -> None:
        """Leave the parameters as torch makes them.

        Args:
            taken: Numbers of the fire modules whose maps are given, ascending, 2..9; none behind the last is computed.
        """
        super().__init__()
        self._taken = tuple(taken)
        self.stem = nn.Conv2d(3, _FIRE_STEM_CHANNELS, 7, stride=2)
        self.fires = nn.ModuleDict()
        n_inputs = _FIRE_STEM_CHANNELS
        for number, (n_squeezed, n_expanded) in enumerate(_FIRES[: self._taken[-1] - _FIRST_FIRE + 1], _FIRST_FIRE):
            self.fires[str(number)] = _Fire(n_inputs, n_squeezed, n_expanded)
            n_inputs = 2 * n_expanded

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps [n, channels, rows, columns], in the order of `taken`; at stride 4 (fires 2..4), 8 (5..8) or 16 (9)."""
        features = functional.relu(self.stem(images))
        maps = []
        for number, fire in self.fires.items():
            if int(number) in _POOLED_BEFORE:
                # Windows may hang over the edge, as in Caffe, which made the weights: torchvision does the same.
                features = functional.max_pool2d(features, 3, 2, ceil_mode=True)
            features = fire(features)
            if int(number) in self._taken:
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
