"""NetVLAD from a file of public weights of any known family: the encodings of the paper's own system (II-A)."""

from deepsimbad.errors import MissingPackageError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.network import NetworkExtractor
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, has_torch, make_run
from deepsimbad.evaluators.weights.files import encodings_sha256
from deepsimbad.evaluators.weights.lock import Lock

_RECIPE = 1  # see `encodings_sha256`; the presets of the families are part of it
_USUAL_SIZE = (640, 480)
_SHORTEST_SIDE = 16  # pixels: of fewer, nothing is left behind four maxima


def netvlad(file: str, compute: Compute) -> NetworkExtractor:
    """As the registry makes it.

    Args:
        file: Name of a file in the weights' folder.
        compute: How it is computed; ONNX Runtime is not for it.

    Raises:
        MissingPackageError: PyTorch is not installed.
        MissingWeightsError: There is no such file.
        InvalidWeightsError: It is damaged, unsafe or of no known family.
        OutOfMemoryError: There is too little memory for it.
    """
    if not has_torch():
        raise MissingPackageError(f"netvlad needs PyTorch: {INSTALL_TORCH}")
    from deepsimbad.evaluators.weights.netvlad_families import read_netvlad

    path, sha256 = Lock.read(compute.weights_dir).pinned(file)
    weights = read_netvlad(path)
    preset = weights.preset
    run = make_run(weights.module, compute, preset.input_size or _USUAL_SIZE)
    return NetworkExtractor(
        run, weights.encoding_dim, encodings_sha256(sha256, _RECIPE), preset.input_size,
        longest_side=preset.longest_side, shortest_side=_SHORTEST_SIDE,
    )  # fmt: skip
