"""The table of known weights, the lock, and archives that are no archives."""

import re
import stat
import zipfile

import pytest
import torch

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError
from deepsimbad.evaluators.extractors import netvlad, squeezenet
from deepsimbad.evaluators.extractors.efficientnet_lite0 import EfficientNetLite0
from deepsimbad.evaluators.nets.netvlad import NetVlad
from deepsimbad.evaluators.registry import EXTRACTOR_PATTERN
from deepsimbad.evaluators.weights import downloads
from deepsimbad.evaluators.weights.downloads import pull_file, unpack
from deepsimbad.evaluators.weights.files import file_sha256
from deepsimbad.evaluators.weights.library import HUB, KNOWN, canonical, known_weights
from deepsimbad.evaluators.weights.lock import FileRecord, Lock, tree_sha256

from .references import FULL, random_network, write_matlab


def test_every_row_can_be_named_in_a_configuration_and_says_what_can_be_known_of_it():
    names = [weights.name for weights in KNOWN] + [canonical(weights.extractor) for weights in KNOWN]
    assert len(set(names)) == len(names)
    for weights in KNOWN:
        assert re.fullmatch(EXTRACTOR_PATTERN, weights.extractor), weights.name
        assert known_weights(weights.name) is known_weights(weights.extractor) is weights
        assert weights.page is None or weights.page.startswith("https://")
        assert weights.url is None or (weights.url.startswith("https://") and weights.file)
        assert weights.sha256 is None or re.fullmatch("[0-9a-f]{8,64}", weights.sha256)
        assert weights.url or weights.page or weights.package, f"{weights.name}: nobody learns where it is"
        is_hub = weights.extractor.startswith(HUB)
        assert weights.commit is None or (is_hub and re.fullmatch("[0-9a-f]{40}", weights.commit))
        assert not is_hub or (weights.encoding_dim and weights.input_size)
    assert known_weights("torchhub:GMBERTON/megaloc:get_trained_model") is known_weights("megaloc")
    for unknown in ("torchhub:gmberton/MegaLoc:Get_trained_model", "nothing"):
        assert known_weights(unknown) is None


def test_what_is_stated_of_our_own_extractors_is_so():
    default = known_weights("efficientnet-lite0")
    assert (default.encoding_dim, default.input_size) == (EfficientNetLite0.encoding_dim, EfficientNetLite0.input_size)
    assert known_weights("squeezenet").encoding_dim == squeezenet.ENCODING_DIM
    assert known_weights("squeezenet").input_size == (squeezenet.TORCHVISION.side,) * 2
    for name, preset in (
        ("netvlad-pitts30k", netvlad.MATLAB),
        ("netvlad-tokyotm", netvlad.MATLAB),
        ("pytorch-netvlad", netvlad.PYTORCH_NETVLAD),
        ("patch-netvlad-mapillary-512", netvlad.PATCH_NETVLAD),
        ("patch-netvlad-pittsburgh-4096", netvlad.PATCH_NETVLAD),
        ("openibl", netvlad.OPENIBL),
    ):
        assert known_weights(name).input_size == preset.input_size, name


@pytest.mark.parametrize(
    ("name", "n_clusters"), [("openibl", 64), *((f"patch-netvlad-mapillary-{d}", 16) for d in (128, 512, 4096))]
)
def test_files_of_netvlad_are_as_large_as_their_numbers(name, n_clusters):
    """In single precision, but for Patch-NetVLAD's whitening in double."""
    weights = known_weights(name)
    with torch.device("meta"):
        network = NetVlad(FULL, n_clusters, weights.encoding_dim, cluster_major=True)
    n_whitening = sum(tensor.numel() for tensor in network.whitening.parameters())
    n_numbers = sum(tensor.numel() for tensor in network.parameters()) + n_whitening * (name != "openibl")
    assert weights.size_mb == pytest.approx(4e-6 * n_numbers, abs=1)


def test_a_tree_is_its_paths_and_contents(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "c.py").write_text("1")
    (tmp_path / "a" / "d.py").write_text("2")
    first = tree_sha256(tmp_path / "a")
    (tmp_path / "a" / "__pycache__").mkdir()
    (tmp_path / "a" / "__pycache__" / "d.pyc").write_text("x")
    assert tree_sha256(tmp_path / "a") == first
    (tmp_path / "a" / "d.py").rename(tmp_path / "a" / "e.py")
    second = tree_sha256(tmp_path / "a")
    (tmp_path / "a" / "e.py").write_text("3")
    assert len({first, second, tree_sha256(tmp_path / "a")}) == 3


def test_a_lock_is_read_as_it_was_written(tmp_path):
    record = FileRecord("1" * 64, 7, "onnx:x.onnx", "https://a.example/x")
    Lock.read(tmp_path / "new").with_file("x.onnx", record).write()
    lock = Lock.read(tmp_path / "new")
    assert lock.files == {"x.onnx": record}
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["weights.lock"]
    (tmp_path / "new" / "x.onnx").write_bytes(b"another")
    (tmp_path / "new" / "mine.onnx").write_bytes(b"mine")
    assert lock.pinned_file("mine.onnx")[1] == file_sha256(tmp_path / "new" / "mine.onnx"), (
        "what nobody recorded is taken"
    )
    with pytest.raises(InvalidWeightsError, match="was recorded with 1111"):
        lock.pinned_file("x.onnx")


def _pull(path, sha256=None):
    return pull_file(path.parent, f"netvlad:{path.name}", lambda *_: None, sha256=sha256)


def test_a_file_that_lies_here_is_recorded_once_it_can_be_loaded(tmp_path):
    path = tmp_path / "net.mat"
    write_matlab(path, random_network("matlab"))
    content = path.read_bytes()
    path.write_bytes(content[:-1000])
    with pytest.raises(InvalidWeightsError, match=r"net\.mat"):
        _pull(path)
    path.write_bytes(content)
    record = _pull(path)
    assert (record.n_bytes, record.url) == (len(content), None)
    path.write_bytes(b"another")
    with pytest.raises(InvalidWeightsError, match=f"{record.sha256}: .* or say --sha256"):
        _pull(path)
    assert _pull(path, file_sha256(path)).n_bytes == 7, "who states the digest vouches for the file"


def test_a_known_file_must_have_the_digest_that_is_known_of_it_and_one_at_no_address_is_put_there_by_hand(tmp_path):
    weights = known_weights("squeezenet")
    (tmp_path / weights.file).write_bytes(b"another")
    for extractor, error, says in (
        (weights.extractor, InvalidWeightsError, "should have b66bff10"),
        (
            "netvlad:checkpoint.pth.tar",
            MissingWeightsError,
            rf"(?s)drive\.google\.com.*{tmp_path}/checkpoint\.pth\.tar",
        ),
        ("onnx:mine.onnx", MissingWeightsError, "--url"),
    ):
        with pytest.raises(error, match=says):
            pull_file(tmp_path, extractor, lambda *_: None)


def _zip(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"r/hubconf.py": "", "r/../../out.py": ""}, "outside"),
        ({"r/hubconf.py": "", "/out.py": ""}, "outside"),
        ({"r/hubconf.py": "", "r/..\\..\\out.py": ""}, "outside"),
        ({"r/hubconf.py": "", "C:/out.py": ""}, "outside"),
        ({"r/hubconf.py": "", "s/other.py": ""}, "no single folder"),
        ({"r/model.py": ""}, "no hubconf.py"),
        ({"r/hubconf.py": b"\0" * 50_000_000}, "more than a repository holds"),
        ({"r/hubconf.py": "", **{f"r/{i}": "" for i in range(30)}}, "more than a repository holds"),
    ],
)
def test_archives_that_are_no_repositories_are_refused(tmp_path, monkeypatch, members, message):
    monkeypatch.setattr(downloads, "_MOST_MEMBERS", 30)
    (tmp_path / "hub").mkdir()
    with pytest.raises(InvalidWeightsError, match=message):
        unpack(_zip(tmp_path / "x.zip", members), tmp_path / "hub" / "to")
    assert list((tmp_path / "hub").iterdir()) == []
    assert not (tmp_path / "out.py").exists()


def test_links_in_an_archive_and_torn_ones_are_refused(tmp_path):
    link = zipfile.ZipInfo("r/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    path = _zip(tmp_path / "x.zip", {"r/hubconf.py": "", link: "/etc/passwd"})
    with pytest.raises(InvalidWeightsError, match="outside"):
        unpack(path, tmp_path / "to")
    for n_bytes in (80, 10, 0):
        path.write_bytes(path.read_bytes()[:n_bytes])
        with pytest.raises(InvalidWeightsError, match="no whole archive"):
            unpack(path, tmp_path / "to")


def test_an_unpacked_repository_replaces_what_was_there(tmp_path):
    (tmp_path / "to").mkdir()
    (tmp_path / "to" / "old.py").write_text("")
    unpack(_zip(tmp_path / "x.zip", {"r/hubconf.py": "new", "r/a/b.py": ""}), tmp_path / "to")
    assert sorted(path.name for path in (tmp_path / "to").iterdir()) == ["a", "hubconf.py"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["to", "x.zip"]
