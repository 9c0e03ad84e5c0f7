"""NetVLAD on VGG16 (Arandjelovic, Gronat, Torii, Pajdla and Sivic, CVPR 2016)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepsimbad.evaluators.nets.vgg16 import Vgg16


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
            encodings = functional.normalize(self.whitening(encodings), dim=1)
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
