"""EfficientNet-Lite0, its stem and first eleven blocks (Tan and Le, 2019).

The Lite variant has no squeeze-and-excitation, and ReLU6. Parameters bear the names of the published checkpoint.
"""

from collections.abc import Iterator, Sequence
from typing import Self

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


class EfficientNetLite(nn.Module):
    """Images [n, 3, height, width] to the maps behind some blocks."""

    def __init__(self, output_blocks: Sequence[int]) -> None:
        """Leave the parameters as torch makes them.

        Args:
            output_blocks: Numbers of the blocks whose maps are given, ascending, 0..10; none behind them is computed.
        """
        super().__init__()
        self._output_blocks = tuple(output_blocks)
        self._conv_stem = _SameConv(3, _STEM_CHANNELS, 3, 2)
        self._bn0 = nn.BatchNorm2d(_STEM_CHANNELS, _EPSILON)
        self._blocks = nn.ModuleList(list(_blocks())[: self._output_blocks[-1] + 1])

    def folded(self) -> Self:
        """The network, every batch normalisation folded into the convolution before it: same maps, a quarter sooner."""
        for module in (self, *self._blocks):
            for conv, norm in _PAIRS:
                if isinstance(getattr(module, conv, None), nn.Conv2d):
                    setattr(module, conv, fuse_conv_bn_eval(getattr(module, conv), getattr(module, norm)))
                    setattr(module, norm, nn.Identity())
        return self

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps [n, channels, height / stride, width / stride], in the order of `output_blocks`."""
        features = functional.relu6(self._bn0(self._conv_stem(images)))
        maps = []
        for number, block in enumerate(self._blocks):
            features = block(features)
            if number in self._output_blocks:
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
