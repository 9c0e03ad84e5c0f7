"""NetVLAD (Arandjelovic, Gronat, Torii, Pajdla and Sivic, CVPR 2016) on VGG16's thirteen convolutions.

VGG16 is that of Simonyan and Zisserman (2015), table 1, column D, cut as NetVLAD cuts it.
"""

import platform
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

STAGES = (2, 2, 3, 3, 3)  # convolutions of each stage; a maximum of 2 x 2 lies between two stages
N_CONVOLUTIONS = sum(STAGES)


class NetVlad(nn.Module):
    """Pixels [n, height, width, 3] uint8 BGR to encodings [n, d] float32 of unit length; sides are 16 or more.

    d is what the whitening leaves, or clusters times channels without it.
    """

    def __init__(self, channels: Sequence[int], n_clusters: int, n_whitened: int | None, cluster_major: bool) -> None:
        """Leave the parameters empty: all of them come from a file.

        Args:
            channels: Widths of VGG16's thirteen convolutions; the last is that of the local features.
            n_clusters: K.
            n_whitened: What the whitening leaves of the clusters' residuals; None: there is no whitening.
            cluster_major: Whether the residual of a cluster lies together in the vector (index k * D + d), or that of a
                channel (d * K + k). A whitening is made for one of the two; in the other it is noise.
        """
        super().__init__()
        n_channels = channels[-1]
        self.trunk = Vgg16(channels)
        self.register_buffer("mean", torch.empty(3))  # of RGB, as pixels are, 0..255
        self.register_buffer("deviation", torch.empty(3))
        self.assignment = nn.Parameter(torch.empty(n_clusters, n_channels))
        self.centres = nn.Parameter(torch.empty(n_clusters, n_channels))
        self.whitening = None if n_whitened is None else nn.Linear(n_clusters * n_channels, n_whitened)
        self._cluster_major = cluster_major

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        images = (pixels.permute(0, 3, 1, 2).flip(1).float() - self._colour("mean")) / self._colour("deviation")
        features = self.trunk(images.to(next(self.trunk.parameters()).dtype))
        features = features.permute(0, 2, 3, 1).flatten(1, 2).float()  # as they lie in memory: channels last
        encodings = functional.normalize(self._aggregated(features), dim=1)
        if self.whitening is not None:
            whitened = self.whitening(encodings.to(self.whitening.weight.dtype))
            encodings = functional.normalize(whitened.float(), dim=1)
        return encodings

    def _colour(self, name: str) -> Tensor:
        return self.get_buffer(name)[:, None, None]

    def _aggregated(self, features: Tensor) -> Tensor:
        """[n, places, D] to [n, K * D]: the residuals of local features to the centres, softly assigned (equation 4).

        The sum of a_k(x) (x - c_k) over places is one product of matrices less sum(a_k) c_k: no residual of a place is
        ever held. Each cluster's is made unit length by itself (section 3.1, "intra-normalization").
        """
        features = functional.normalize(features, dim=2)
        shares = torch.softmax(functional.linear(features, self.assignment), dim=2).transpose(1, 2)  # [n, K, places]
        residuals = torch.matmul(shares, features) - shares.sum(2, keepdim=True) * self.centres
        residuals = functional.normalize(residuals, dim=2)  # [n, K, D]
        return (residuals if self._cluster_major else residuals.transpose(1, 2)).flatten(1)


class Vgg16(nn.Module):
    """Images [n, 3, height, width] to local features [n, channels, height // 16, width // 16].

    The last convolution has no ReLU behind it (Arandjelovic et al., 2016, section 5.1: "cropped at the last
    convolutional layer, before ReLU").
    """

    def __init__(self, channels: Sequence[int]) -> None:
        """Leave the parameters as torch makes them."""
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
                features = _halved(features)
            for convolution in self.convolutions[number : number + n_convolutions]:
                features = convolution(features)
            number += n_convolutions
        return features


def _halved(features: Tensor) -> Tensor:
    """The greatest of every 2 x 2 places; of an odd side the last are left out.

    As `max_pool2d` has it, which in bfloat16 on a processor takes five times as long.
    """
    height, width = (side // 2 * 2 for side in features.shape[2:])
    rows = torch.maximum(features[:, :, 0:height:2], features[:, :, 1:height:2])
    return torch.maximum(rows[..., 0:width:2], rows[..., 1:width:2])


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
        """The weights in the processor's own layout; made anew after they were cast or moved."""
        source = (self.weight.data_ptr(), self.weight.dtype)
        packed = self._packed  # two threads at worst both make it
        if packed is None or packed[0] != source:
            weights = torch.ops.mkldnn._reorder_convolution_weight(
                self.weight, [1, 1], [1, 1], [1, 1], 1, list(features.shape)
            )
            packed = self._packed = (source, weights)
        return packed[1]


@cache
def _can_pack(dtype: torch.dtype) -> bool:
    """Whether this processor and PyTorch can keep weights in that layout: the operators belong to torch.compile."""
    operators = ("_convolution_pointwise", "_reorder_convolution_weight", "_is_mkldnn_bf16_supported")
    if platform.machine().lower() not in {"x86_64", "amd64"}:
        return False
    has_mkldnn = bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]
    if not has_mkldnn or not all(hasattr(torch.ops.mkldnn, operator) for operator in operators):
        return False
    return dtype is torch.float32 or (dtype is torch.bfloat16 and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported()))
