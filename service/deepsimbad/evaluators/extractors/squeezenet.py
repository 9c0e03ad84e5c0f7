"""SqueezeNet from a file of its public weights: a map from its middle, averaged in a grid, as by the default extractor.

The map is that behind the last fire module, at stride 16. On Nordland, the corridor and the rendered campus the modules
5, 7 and 8 found fewer places across seasons, and 7 and 9 together hardly more for nearly twice the numbers.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from deepsimbad.errors import MissingPackageError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import NetworkExtractor
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, has_torch, make_run
from deepsimbad.evaluators.weights.files import encodings_sha256
from deepsimbad.evaluators.weights.lock import Lock

if TYPE_CHECKING:
    from torch import nn

CELLS = (6, 5)  # rows and columns, as of the default extractor
TAKEN = {9: 512}  # fire module -> its channels
ENCODING_DIM = CELLS[0] * CELLS[1] * sum(TAKEN.values())
_RECIPE = 1  # see `encodings_sha256`


def squeezenet(file: str, compute: Compute) -> NetworkExtractor:
    """As the registry makes it; a file in the weights' folder; raises as `Evaluator.load`."""
    if not has_torch():
        raise MissingPackageError(f"squeezenet needs PyTorch: {INSTALL_TORCH}")
    from deepsimbad.evaluators.weights.squeezenet_families import preset_of

    path, sha256 = Lock.read(compute.weights_dir).pinned(file)
    size = (preset_of(path).side,) * 2
    run = make_run(lambda: _module(path), compute, size, f"squeezenet-{_RECIPE}-{sha256[:16]}")
    return NetworkExtractor(run, ENCODING_DIM, encodings_sha256(sha256, _RECIPE), size)


def _module(path: Path) -> "nn.Module":
    from deepsimbad.evaluators.nets.spatial_grid import SpatialGrid
    from deepsimbad.evaluators.weights.squeezenet_families import read_squeezenet

    weights = read_squeezenet(path)
    preset = weights.preset
    return SpatialGrid(weights.trunk(tuple(TAKEN)), CELLS, preset.mean, preset.std, is_rgb=preset.is_rgb)
