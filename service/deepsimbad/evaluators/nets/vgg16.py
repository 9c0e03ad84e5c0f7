"""VGG16's thirteen convolutions (Simonyan and Zisserman, 2015, table 1, column D), cut as NetVLAD cuts them."""

import platform
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

STAGES = (2, 2, 3, 3, 3)  # convolutions of each stage; a maximum of 2 x 2 lies between two stages
N_CONVOLUTIONS = sum(STAGES)


class Vgg16(nn.Module):
    """Images [n, 3, height, width] to local features [n, channels, height // 16, width // 16].

    The last convolution has no ReLU behind it (Arandjelovic et al., 2016, section 5.1: "cropped at the last
    convolutional layer, before ReLU").
    """

    def __init__(self, channels: Sequence[int]) -> None:
        """Leave the parameters as torch makes them.

        Args:
            channels: Width of each of the thirteen convolutions.
        """
        super().__init__()
        widths = list(pairwise((3, *channels)))
        self.convolutions = nn.ModuleList(
            _Convolution(n_inputs, n_outputs, rectified=number < N_CONVOLUTIONS)
            for number, (n_inputs, n_outputs) in enumerate(widths, start=1)
        )

    def forward(self, images: Tensor) -> Tensor:
        """See the class."""
        features, number = images, 0
        for stage, n_convolutions in enumerate(STAGES):
            if stage:
                features = functional.max_pool2d(features, 2)
            for convolution in self.convolutions[number : number + n_convolutions]:
                features = convolution(features)
            number += n_convolutions
        return features


class _Convolution(nn.Conv2d):
    """A convolution of 3 x 3 that lays its weights out for the processor once.

    A plain `nn.Conv2d` does that at every call, which for one image costs a seventh of the time in bfloat16. What it
    gives is the same, and its parameters are those of `nn.Conv2d`.
    """

    def __init__(self, n_inputs: int, n_outputs: int, rectified: bool) -> None:
        super().__init__(n_inputs, n_outputs, 3, padding=1)
        self._rectified = rectified
        self._packed: tuple[tuple[int, torch.dtype], Tensor] | None = None

    def forward(self, features: Tensor) -> Tensor:
        if features.device.type == "cpu" and not torch.is_grad_enabled() and _can_pack(features.dtype):
            attribute = "relu" if self._rectified else "none"
            return torch.ops.mkldnn._convolution_pointwise(  # type: ignore[no-any-return]
                features, self._packed_for(features), self.bias, [1, 1], [1, 1], [1, 1], 1, attribute, [], ""
            )
        convolved = super().forward(features)
        return functional.relu(convolved) if self._rectified else convolved

    def _packed_for(self, features: Tensor) -> Tensor:
        """The weights as the processor wants them; made anew when they were cast or moved since."""
        made_of = (self.weight.data_ptr(), self.weight.dtype)
        packed = self._packed  # two threads at worst both make it
        if packed is None or packed[0] != made_of:
            laid_out = torch.ops.mkldnn._reorder_convolution_weight(
                self.weight, [1, 1], [1, 1], [1, 1], 1, list(features.shape)
            )
            packed = self._packed = (made_of, laid_out)
        return packed[1]


@cache
def _can_pack(dtype: torch.dtype) -> bool:
    """Whether this processor and this PyTorch keep weights laid out: the operators belong to torch.compile."""
    operators = ("_convolution_pointwise", "_reorder_convolution_weight", "_is_mkldnn_bf16_supported")
    if platform.machine().lower() not in {"x86_64", "amd64"}:
        return False
    has_mkldnn = bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]
    if not has_mkldnn or not all(hasattr(torch.ops.mkldnn, operator) for operator in operators):
        return False
    return dtype is torch.float32 or (dtype is torch.bfloat16 and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported()))
