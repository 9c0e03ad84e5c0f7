"""Files of weights that are damaged, of another network or hostile: a named error each, and nothing is run."""

import pickle
import struct
import zipfile
import zlib
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.netvlad import netvlad
from deepsimbad.evaluators.extractors.squeezenet import squeezenet
from deepsimbad.evaluators.weights.files import read_variable

from . import references
from .references import NETVLAD_WRITERS, SQUEEZENET_WRITERS, random_network, random_squeezenet

FAMILIES = [*NETVLAD_WRITERS, *SQUEEZENET_WRITERS]
EXTRACTORS = [netvlad, squeezenet]
HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
PARAMETERS = random_squeezenet()


def load(path, extractor=netvlad):
    return extractor(path.name, Compute(Runtime.TORCH, Device.CPU, weights_dir=path.parent))


def assert_refused(path, message=None, extractor=netvlad):
    with pytest.raises(InvalidWeightsError, match=message) as caught:
        load(path, extractor)
    assert path.name in caught.value.message


def write_weights(folder, family):
    """Write a file of a family; returns its path and its extractor."""
    path = folder / f"{family}.weights"
    if family in NETVLAD_WRITERS:
        NETVLAD_WRITERS[family](path, random_network(family))
        return path, netvlad
    SQUEEZENET_WRITERS[family](path, PARAMETERS)
    return path, squeezenet


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_a_missing_file_says_where_to_put_it(tmp_path, extractor):
    with pytest.raises(MissingWeightsError, match="put it at") as caught:
        load(tmp_path / "absent", extractor)
    assert str(tmp_path / "absent") in caught.value.message


@pytest.mark.parametrize("family", FAMILIES)
def test_a_truncated_file(tmp_path, family):
    path, extractor = write_weights(tmp_path, family)
    body = path.read_bytes()
    for share in (0.0, 0.001, 0.1, 0.5, 0.97):
        path.write_bytes(body[: int(len(body) * share)])
        assert_refused(path, extractor=extractor)


def test_a_truncated_file_that_was_not_compressed(tmp_path):
    path = tmp_path / "net.mat"
    references.write_matlab(path, random_network("matlab"), compressed=False)
    body = path.read_bytes()
    for n_bytes in (130, 200, len(body) // 2, len(body) - 1):
        path.write_bytes(body[:n_bytes])
        assert_refused(path, "no whole MATLAB file")


@pytest.mark.parametrize("family", NETVLAD_WRITERS)
def test_flipped_bytes_end_in_a_named_error_or_in_other_numbers(tmp_path, family):
    path, extractor = write_weights(tmp_path, family)
    body, random = path.read_bytes(), np.random.default_rng(2)
    for _ in range(40):
        harmed = bytearray(body)
        for place in random.integers(0, min(len(body), 4000), 3):
            harmed[place] ^= 1 << int(random.integers(8))
        path.write_bytes(harmed)
        with suppress(InvalidWeightsError):
            load(path, extractor)


@pytest.mark.parametrize("family", ["pytorch_netvlad", "patch_netvlad", "openibl", "torchvision"])
def test_a_parameter_too_many_or_too_few_is_another_network(tmp_path, family):
    path, extractor = write_weights(tmp_path, family)
    content = torch.load(path, weights_only=False)
    names = content.get("state_dict", content)
    first = next(iter(names))
    if extractor is netvlad:  # of SqueezeNet the head is passed over
        names[f"{first}_more"] = names[first]
        torch.save(content, path)
        assert_refused(path, "another network")
        del names[f"{first}_more"]
    del names[first]
    torch.save(content, path)
    assert_refused(path, first if extractor is netvlad else r"stem\.weight", extractor)


@pytest.mark.parametrize(
    ("name", "tensor"),  # as the file calls it, which the error says
    [
        ("encoder.5.weight", torch.zeros(8, 6, 5, 5)),
        ("encoder.5.bias", torch.zeros(7)),
        ("encoder.5.bias", torch.zeros(0)),
        ("encoder.5.bias", torch.tensor(1.0)),
        ("pool.centroids", torch.zeros(5, 11)),
        ("pool.conv.weight", torch.zeros(5, 12, 1, 2)),
        ("WPCA.0.weight", torch.zeros(16, 61, 1, 1)),
        ("WPCA.0.bias", torch.full((16,), torch.nan)),
        ("encoder.0.weight", torch.full((6, 3, 3, 3), torch.inf)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3, dtype=torch.int32)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3, dtype=torch.complex64)),
        ("encoder.0.weight", torch.zeros(6, 3, 3, 3).to_sparse()),
        ("encoder.0.weight", [1.0]),
        ("WPCA.0.weight", torch.zeros(1).expand(1 << 25, 1 << 25)),  # a million million numbers that lie on one
    ],
)
def test_wrong_tensors(tmp_path, name, tensor):
    path = tmp_path / "patch.pth.tar"
    references.write_patch_netvlad(path, random_network("patch_netvlad"), **{name: tensor})
    assert_refused(path, name)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("fire7/conv3x3_2/w", np.zeros((192, 48, 1, 1), np.float32)),
        ("fire7/conv3x3_2/b", np.full(192, np.nan, np.float32)),
        ("fire7/conv3x3_2/b", np.zeros(192, np.int64)),
        ("conv1/w", np.zeros((64, 3, 3, 3), np.float32)),  # of version 1.1
        ("conv1/b", np.array([None])),
        ("fire5/conv1x1_1/w", None),
    ],
)
def test_wrong_arrays(tmp_path, name, array):
    changed = {key: value for key, value in (PARAMETERS | {name: array}).items() if value is not None}
    references.write_caffe(tmp_path / "weights.npz", changed)
    assert_refused(tmp_path / "weights.npz", extractor=squeezenet)


def weights_of(layer, *arrays):
    """Replaces the weights of a layer of a MATLAB network, by what is made of them."""

    def change(net):
        weights = np.empty((1, len(arrays)), object)
        for place, array in enumerate(arrays):
            weights[0, place] = array(net["layers"][0, layer]["weights"]) if callable(array) else array
        net["layers"][0, layer]["weights"] = weights

    return change


def average(colour):
    return lambda net: net["meta"]["normalization"].update(averageImage=colour)


@pytest.mark.parametrize(
    "change",
    [
        lambda net: net.pop("layers"),
        lambda net: net.update(layers=net["layers"][:, :33]),  # the network without its whitening
        lambda net: net["meta"]["normalization"].pop("averageImage"),
        average(np.zeros((4, 4))),
        average(np.full((1, 3), np.inf)),
        weights_of(30, "no", "numbers"),
        weights_of(0, {"a": 1.0}, {"b": 2.0}),
        weights_of(30, lambda old: old[0, 0], lambda old: old[0, 1], lambda old: old[0, 1]),
        weights_of(33, lambda old: old[0, 0][0, 0].T, lambda old: old[0, 1]),
        weights_of(2, np.zeros((5, 5, 6, 6), np.float32), lambda old: old[0, 1]),
        weights_of(2, lambda old: old[0, 0] * np.float32(np.nan), lambda old: old[0, 1]),
        weights_of(2, lambda old: old[0, 0], np.zeros((6, 1), np.int32)),
    ],
)
def test_a_matlab_file_of_another_network(tmp_path, change):
    net = references.matlab_net(random_network("matlab"))
    change(net)
    savemat(tmp_path / "net.mat", {"net": net})
    assert_refused(tmp_path / "net.mat")


def element(kind, body):
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def array(kind, sizes, rest, name=b""):
    """The body of a MATLAB array: flags, dimensions, name and what follows."""
    flags = element(6, struct.pack("<II", kind, 0))
    return flags + element(5, struct.pack(f"<{len(sizes)}i", *sizes)) + element(1, name) + rest


def matlab_bomb(path):
    packer, n_bytes = zlib.compressobj(9), 40 << 20
    packed = packer.compress(struct.pack("<II", 14, n_bytes))
    packed += b"".join(packer.compress(bytes(1 << 20)) for _ in range(n_bytes >> 20)) + packer.flush()
    path.write_bytes(HEADER + struct.pack("<II", 15, len(packed)) + packed)


def archive_bomb(path, member="archive/data/0"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(member, "w") as stream:
        for _ in range(100):
            stream.write(bytes(1 << 20))


def nested_cells():
    head = array(1, (1, 1), b"")
    parts, n_bytes = [struct.pack("<II", 14, 0)], 8
    for _ in range(100_000):
        parts.append(struct.pack("<II", 14, len(head) + n_bytes) + head)
        n_bytes += 8 + len(head)
    return HEADER + element(14, array(1, (1, 1), b"".join(reversed(parts)), b"net"))


def openibl_without_its_whitening(path):
    """As its training leaves it, which keeps the whitening in another file: the encoding would be another one."""
    names = references.torch_names(random_network("openibl"), "base_model.base.{}", "net_vlad.{}", "pca_layer")
    torch.save({name: tensor for name, tensor in names.items() if "pca" not in name}, path)


def array_that_claims_more_than_it_holds(path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776, 96), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("conv1/w.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)


RANDOM = [np.random.default_rng(seed).bytes(n) for seed, n in ((0, 5000), (1, 300))]
NO_WEIGHTS = [b"PK", b"PK\x03\x04" + bytes(60), b"MATLAB", HEADER, HEADER[:126] + b"MI"]
NO_WEIGHTS += [b"MATLAB 7.3 MAT-file" + bytes(200), bytes(range(256)) * 40, RANDOM[0], b"\x80\x02" + RANDOM[1]]
NO_CHECKPOINTS = [{}, [], 3, {"state_dict": 3}, {"features.0.weight": torch.zeros(3)}]
IMPOSSIBLE_SIZES = [
    array(1, (2**31 - 1, 2**31 - 1), b"", b"net"),
    array(1, (-1, 1), b"", b"net"),
    array(7, (2**31 - 1, 4), element(7, bytes(16)), b"net"),
    array(7, (4,), struct.pack("<II", 7, 2**32 - 16), b"net"),
    array(2, (1, 1), element(5, struct.pack("<i", 0)) + element(1, b""), b"net"),
    array(2, (1, 1), element(5, struct.pack("<i", -3)) + element(1, b"abc"), b"net"),
    array(2, (1, 1), element(5, struct.pack("<i", 2**31 - 1)) + element(1, b"abc"), b"net"),
    element(6, b""),
    b"\xff" * 64,
]


@pytest.mark.parametrize(
    ("content", "extractor", "message"),
    [
        *((content, extractor, None) for content in NO_WEIGHTS for extractor in EXTRACTORS),
        *((partial(torch.save, content), extractor, None) for content in NO_CHECKPOINTS for extractor in EXTRACTORS),
        *((HEADER + element(14, body), netvlad, "no whole MATLAB file") for body in IMPOSSIBLE_SIZES),
        pytest.param(lambda path: savemat(path, {"dbStruct": 3}), netvlad, "no variable net", id="no net"),
        pytest.param(lambda path: savemat(path, {"net": np.zeros(3)}), netvlad, "another network", id="no struct"),
        (openibl_without_its_whitening, netvlad, None),
        pytest.param(nested_cells(), netvlad, "nested deeper", id="cells in cells do not end the process"),
        (array_that_claims_more_than_it_holds, squeezenet, None),
        (matlab_bomb, netvlad, "20 times its size"),
        (archive_bomb, netvlad, "20 times its size"),
        pytest.param(partial(archive_bomb, member="conv1/w.npy"), squeezenet, "20 times its size", id="numpy_bomb"),
    ],
)
def test_no_file_of_weights(tmp_path, content, extractor, message):
    path = tmp_path / "file.mat"
    path.write_bytes(content) if isinstance(content, bytes) else content(path)
    assert_refused(path, message, extractor)


def test_what_is_no_number_text_cell_or_struct_is_passed_over(tmp_path):
    """A function handle, an object and a sparse matrix are never made into anything."""
    handle = array(16, (1, 1), element(14, b""))
    fields = element(5, struct.pack("<i", 8)) + element(1, b"one\0\0\0\0\0two\0\0\0\0\0")
    number = element(14, array(6, (1, 1), element(9, struct.pack("<d", 2.5))))
    struct_of_both = array(2, (1, 1), fields + element(14, handle) + number, b"net")
    (tmp_path / "handle").write_bytes(HEADER + element(14, struct_of_both))
    content = read_variable(tmp_path / "handle", "net")
    assert (content["one"], content["two"]) == (None, 2.5)


class _Sentinel:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_code_in_a_file_is_not_run(tmp_path, extractor):
    sentinel, path = tmp_path / "it ran", tmp_path / "weights"
    content = {"state_dict": {"pool.centroids": _Sentinel(sentinel)}, "features.0.weight": _Sentinel(sentinel)}
    for zipped in (True, False):
        torch.save(content, path, _use_new_zipfile_serialization=zipped)
        assert_refused(path, "more than tensors", extractor)
    references.write_caffe(path, PARAMETERS | {"conv1/w": np.array([_Sentinel(sentinel)], object)})
    assert_refused(path, extractor=extractor)
    path.write_bytes(pickle.dumps(content))
    assert_refused(path, extractor=extractor)
    assert not sentinel.exists()
    pickle.loads(path.read_bytes())
    assert sentinel.exists()  # and it would have
