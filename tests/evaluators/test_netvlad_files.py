"""Files of weights that are damaged, of another network or hostile: a named error each, and nothing is run."""

import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.netvlad import netvlad
from deepsimbad.evaluators.weights.matlab_struct import read_variable
from tests.evaluators import netvlad_reference as reference

FAMILIES = sorted(reference.WRITERS)
Bytes = Callable[[bytes], bytes]
HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"


def made(path: Path) -> None:
    netvlad(path.name, Compute(Runtime.TORCH, Device.CPU, weights_dir=path.parent))


def refused(path: Path, message: str | None = None) -> None:
    with pytest.raises(InvalidWeightsError, match=message) as caught:
        made(path)
    assert path.name in caught.value.message


def whole(folder: Path, family: str) -> Path:
    path = folder / f"{family}.weights"
    reference.WRITERS[family](path, reference.random_network(family))
    return path


def test_a_missing_file_says_where_to_put_it(tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match="put it at") as caught:
        made(tmp_path / "absent.mat")
    assert str(tmp_path / "absent.mat") in caught.value.message


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.97])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_truncated_file(tmp_path: Path, family: str, share: float) -> None:
    path = whole(tmp_path, family)
    body = path.read_bytes()
    path.write_bytes(body[: int(len(body) * share)])
    refused(path)


def test_a_truncated_file_that_was_not_compressed(tmp_path: Path) -> None:
    path = tmp_path / "net.mat"
    reference.write_matlab(path, reference.random_network("matlab"), compressed=False)
    body = path.read_bytes()
    for n_bytes in (130, 200, len(body) // 2, len(body) - 1):
        path.write_bytes(body[:n_bytes])
        refused(path, "no whole MATLAB file")


@pytest.mark.parametrize(
    "body",
    [b"", b"PK", b"PK\x03\x04" + bytes(60), b"MATLAB", HEADER, HEADER[:126] + b"MI",
     b"MATLAB 7.3 MAT-file" + bytes(200), bytes(range(256)) * 40,
     np.random.default_rng(0).bytes(5000), b"\x80\x02" + np.random.default_rng(1).bytes(300)],
)  # fmt: skip
def test_no_file_of_weights_at_all(tmp_path: Path, body: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(body)
    refused(path)


@pytest.mark.parametrize("family", FAMILIES)
def test_flipped_bytes_end_in_a_named_error_or_in_other_numbers(tmp_path: Path, family: str) -> None:
    path = whole(tmp_path, family)
    body = path.read_bytes()
    random = np.random.default_rng(2)
    for _ in range(40):
        harmed = bytearray(body)
        for place in random.integers(0, min(len(body), 4000), 3):
            harmed[place] ^= 1 << int(random.integers(8))
        path.write_bytes(harmed)
        with suppress(InvalidWeightsError):
            made(path)


@pytest.mark.parametrize("family", ["pytorch_netvlad", "patch_netvlad", "openibl"])
def test_another_network(tmp_path: Path, family: str) -> None:
    path = whole(tmp_path, family)
    content = torch.load(path, weights_only=False)
    names = content.get("state_dict", content)
    first = next(iter(names))
    names[f"{first}_more"] = names[first]
    torch.save(content, path)
    refused(path, "another network")
    del names[f"{first}_more"], names[first]
    torch.save(content, path)
    refused(path, first)


@pytest.mark.parametrize("content", [{}, [], 3, {"state_dict": 3}, {"features.0.weight": torch.zeros(3)}])
def test_a_checkpoint_of_no_family(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "other.pth"
    torch.save(content, path)
    refused(path)


def test_openibl_without_its_whitening(tmp_path: Path) -> None:
    """Its training keeps the whitening in another file; without it the encoding would not be what is published."""
    path = tmp_path / "model_best.pth.tar"
    network = reference.random_network("openibl")
    names = reference.torch_names(network, "base_model.base.{}", "net_vlad.{}", "pca_layer")
    torch.save({name: tensor for name, tensor in names.items() if "pca" not in name}, path)
    refused(path)


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("encoder.5.weight", torch.zeros(8, 6, 5, 5)),
        ("encoder.5.bias", torch.zeros(7)),
        ("encoder.5.bias", torch.zeros(0)),
        ("encoder.5.bias", torch.tensor(1.0)),
        ("pool.centroids", torch.zeros(5, 11)),
        ("pool.conv.weight", torch.zeros(5, 12, 1, 2)),
        ("WPCA.0.weight", torch.zeros(16, 61, 1, 1)),
        ("WPCA.0.bias", torch.zeros(15)),
        ("WPCA.0.bias", torch.full((16,), torch.nan)),
        ("encoder.0.weight", torch.full((6, 3, 3, 3), torch.inf)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3, dtype=torch.int32)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3, dtype=torch.complex64)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3).to_sparse()),
        ("encoder.0.weight", [1.0]),
        # A thousand million million numbers that lie on one.
        ("WPCA.0.weight", torch.zeros(1).expand(1 << 25, 1 << 25)),
        ("WPCA.0.bias", torch.zeros(1).expand(1 << 40)),
    ],
)
def test_wrong_shapes_and_numbers(tmp_path: Path, name: str, tensor: Any) -> None:
    path = tmp_path / "patch.pth.tar"
    reference.write_patch_netvlad(path, reference.random_network("patch_netvlad"), **{name: tensor})
    refused(path)


def without_layers(net: Any) -> None:
    del net["layers"]


def too_few_layers(net: Any) -> None:
    net["layers"] = net["layers"][:, :33]  # the network without its whitening


def text_for_numbers(net: Any) -> None:
    weights = np.empty((1, 2), object)
    weights[0, 0], weights[0, 1] = "no", "numbers"
    net["layers"][0, 30]["weights"] = weights


def structs_for_numbers(net: Any) -> None:
    weights = np.empty((1, 2), object)
    weights[0, 0], weights[0, 1] = {"a": 1.0}, {"b": 2.0}
    net["layers"][0, 0]["weights"] = weights


def three_weights(net: Any) -> None:
    weights = net["layers"][0, 30]["weights"]
    net["layers"][0, 30]["weights"] = reference.cell(weights[0, 0], weights[0, 1], weights[0, 1])


def turned_whitening(net: Any) -> None:
    weights = net["layers"][0, 33]["weights"]
    net["layers"][0, 33]["weights"] = reference.cell(weights[0, 0][0, 0].T, weights[0, 1])


def other_kernel(net: Any) -> None:
    net["layers"][0, 2]["weights"][0, 0] = np.zeros((5, 5, 6, 6), np.float32)


def not_a_number(net: Any) -> None:
    net["layers"][0, 2]["weights"][0, 0][0, 0, 0, 0] = np.nan


def whole_numbers(net: Any) -> None:
    net["layers"][0, 2]["weights"][0, 1] = np.zeros((6, 1), np.int32)


def without_average(net: Any) -> None:
    del net["meta"]["normalization"]["averageImage"]


def grey_average(net: Any) -> None:
    net["meta"]["normalization"]["averageImage"] = np.zeros((4, 4))


def endless_average(net: Any) -> None:
    net["meta"]["normalization"]["averageImage"] = np.full((1, 3), np.inf)


@pytest.mark.parametrize(
    "change",
    [without_layers, too_few_layers, text_for_numbers, structs_for_numbers, three_weights, turned_whitening,
     other_kernel, not_a_number, whole_numbers, without_average, grey_average, endless_average],
    ids=lambda change: change.__name__,
)  # fmt: skip
def test_a_matlab_file_of_another_network(tmp_path: Path, change: Callable[[Any], None]) -> None:
    path = tmp_path / "net.mat"
    net = reference.matlab_net(reference.random_network("matlab"))
    change(net)
    savemat(path, {"net": net})
    refused(path)


def test_a_matlab_file_without_the_struct(tmp_path: Path) -> None:
    path = tmp_path / "other.mat"
    savemat(path, {"dbStruct": {"utm": np.zeros((3, 2))}})
    refused(path, "no variable net")
    savemat(path, {"net": np.zeros(3)})
    refused(path, "another network")


def element(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def array(kind: int, sizes: tuple[int, ...], rest: bytes, name: bytes = b"") -> bytes:
    """The body of a MATLAB array: flags, dimensions, name and what follows."""
    flags = element(6, struct.pack("<II", kind, 0))
    return flags + element(5, struct.pack(f"<{len(sizes)}i", *sizes)) + element(1, name) + rest


def test_cells_inside_cells_do_not_end_the_process(tmp_path: Path) -> None:
    head = array(1, (1, 1), b"")
    parts, n_bytes = [struct.pack("<II", 14, 0)], 8
    for _ in range(100_000):
        parts.append(struct.pack("<II", 14, len(head) + n_bytes) + head)
        n_bytes += 8 + len(head)
    path = tmp_path / "deep.mat"
    path.write_bytes(HEADER + element(14, array(1, (1, 1), b"".join(reversed(parts)), b"net")))
    refused(path, "nested deeper")


@pytest.mark.parametrize(
    "body",
    [
        array(1, (2**31 - 1, 2**31 - 1), b"", b"net"),
        array(1, (-1, 1), b"", b"net"),
        array(7, (2**31 - 1, 4), element(7, bytes(16)), b"net"),
        array(7, (4,), struct.pack("<II", 7, 2**32 - 16), b"net"),
        array(2, (1, 1), element(5, struct.pack("<i", 0)) + element(1, b""), b"net"),
        array(2, (1, 1), element(5, struct.pack("<i", -3)) + element(1, b"abc"), b"net"),
        array(2, (1, 1), element(5, struct.pack("<i", 2**31 - 1)) + element(1, b"abc"), b"net"),
        element(6, b""),
        b"\xff" * 64,
    ],
)
def test_sizes_that_cannot_be(tmp_path: Path, body: bytes) -> None:
    path = tmp_path / "sizes.mat"
    path.write_bytes(HEADER + element(14, body))
    refused(path, "no whole MATLAB file")


def test_a_matlab_file_that_unpacks_without_end(tmp_path: Path) -> None:
    packer = zlib.compressobj(9)
    n_bytes = 40 << 20
    packed = packer.compress(struct.pack("<II", 14, n_bytes))
    packed += b"".join(packer.compress(bytes(1 << 20)) for _ in range(n_bytes >> 20)) + packer.flush()
    path = tmp_path / "bomb.mat"
    path.write_bytes(HEADER + struct.pack("<II", 15, len(packed)) + packed)
    refused(path, "unpacks to more")


def test_a_checkpoint_that_unpacks_without_end(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pth"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("archive/data/0", "w") as member:
        for _ in range(200):
            member.write(bytes(1 << 20))
    refused(path, "unpacks to")


class _Sentinel:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_checkpoint_is_not_run(tmp_path: Path, zipped: bool) -> None:
    sentinel = tmp_path / "it ran"
    path = tmp_path / "hostile.pth"
    content = {"state_dict": {"pool.centroids": _Sentinel(sentinel)}}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    refused(path, "more than tensors")
    assert not sentinel.exists()
    path.write_bytes(pickle.dumps(content))
    refused(path)
    assert not sentinel.exists()
    pickle.loads(path.read_bytes())
    assert sentinel.exists()  # and it would have


def test_what_is_no_number_text_cell_or_struct_is_passed_over(tmp_path: Path) -> None:
    """A function handle, an object and a sparse matrix are never made into anything."""
    handle = array(16, (1, 1), element(14, b""))
    fields = element(5, struct.pack("<i", 8)) + element(1, b"one\0\0\0\0\0two\0\0\0\0\0")
    number = element(14, array(6, (1, 1), element(9, struct.pack("<d", 2.5))))
    path = tmp_path / "handle.mat"
    path.write_bytes(HEADER + element(14, array(2, (1, 1), fields + element(14, handle) + number, b"net")))
    found = read_variable(path, "net")
    assert found["one"] is None
    assert found["two"] == 2.5
