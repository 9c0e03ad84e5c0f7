"""Torch hub repositories: pulled from an archive that lies here, then loaded as any domain would."""

import contextlib
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError, OutOfMemoryError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.torchhub import torchhub
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.evaluators.weights import downloads
from deepsimbad.evaluators.weights.downloads import HubWish, pull_hub
from deepsimbad.evaluators.weights.lock import LOCK, Lock

COMMIT = "0123456789abcdef0123456789abcdef01234567"
REPOSITORY = "someone/Places"
SIZE = (28, 42)

MODEL = """
import torch

class Means(torch.nn.Module):
    def __init__(self, dim, form="tensor"):
        super().__init__()
        self.form = form
        self.project = torch.nn.Linear(12, dim, bias=False)
        torch.nn.init.constant_(self.project.weight, 0.1)
        with torch.no_grad():
            self.project.weight[:, ::2] += torch.arange(dim)[:, None] / dim

    def forward(self, x):
        means = torch.nn.functional.adaptive_avg_pool2d(x, 2).flatten(1)
        y = self.project(means)
        return {
            "tensor": y, "pair": (torch.zeros(3), x, y, y + 1), "dict": {"y": y}, "map": x, "one": y[:1],
            "nan": y / 0, "whole": y.long(), "flat": y[0], "zero": y * 0,
        }[self.form]
"""
HUBCONF = """
dependencies = ["torch"]
import torch
from places_model import Means

def entry(dim=8, form="tensor"):
    print("noise on standard output")
    return Means(dim, form)

def wrapped():
    return torch.nn.DataParallel(Means(8))

def broken():
    raise ValueError("there is nothing to see")

def ending():
    raise SystemExit(3)

def text():
    return "no model"

def random():
    model = Means(8)
    torch.nn.init.normal_(model.project.weight)
    return model

def needing():
    import a_package_nobody_has

def checkpoint(name="places.pth"):
    model = Means(8)
    model.load_state_dict(torch.hub.load_state_dict_from_url("http://127.0.0.1:9/" + name, map_location="cpu"))
    return model

def secret():
    import urllib.request
    try:
        urllib.request.urlopen("http://127.0.0.1:9/secret")
    except OSError:
        pass
    import socket
    socket.create_connection(("127.0.0.1", 9))

def nested():
    inner = torch.hub.load("elsewhere/backbone", "backbone")
    model = Means(8)
    model.backbone = inner
    return model
"""


def leave_archive(folder, files, repository=REPOSITORY, commit=COMMIT):
    """Put an archive where a pull looks for it, as somebody without a network would."""
    hub = folder / "hub"
    hub.mkdir(parents=True, exist_ok=True)
    path = hub / f"{repository.replace('/', '_')}_{commit}.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(zipfile.ZipInfo(f"Places-{commit}/{name}"), text)
    return path


def pull(folder, entry="entry", files=None, **wish):
    leave_archive(folder, files or {"hubconf.py": HUBCONF, "places_model.py": MODEL})
    wish = {"commit": COMMIT, "input_size": SIZE, **wish}
    return pull_hub(folder, HubWish(f"torchhub:{REPOSITORY}:{entry}", **wish), lambda *_: None)


def load(folder, entry="entry", **compute):
    return torchhub(f"{REPOSITORY}:{entry}", Compute(weights_dir=folder, device=Device.CPU, **compute))


@pytest.fixture(autouse=True)
def _the_process_stays_as_it_was():
    earlier_state = (set(sys.modules), list(sys.path), torch.hub.get_dir(), torch.hub.download_url_to_file, sys.stdout)
    yield
    assert "places_model" not in sys.modules
    assert (list(sys.path), torch.hub.get_dir(), torch.hub.download_url_to_file, sys.stdout) == earlier_state[1:]


def scenes(n=3):
    return list(np.random.default_rng(5).integers(0, 255, (n, 30, 40, 3), np.uint8))


def by_hand(image, dim=8):
    """[dim] the encoding of an image in plain numpy, without resizing."""
    rgb = image[..., ::-1].astype(np.float64) / 255
    normalised = (rgb - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    height, width = image.shape[:2]
    cells = [
        [normalised[y : y + height // 2, x : x + width // 2].mean(axis=(0, 1)) for x in (0, width // 2)]
        for y in (0, height // 2)
    ]
    means = np.array(cells).transpose(2, 0, 1).ravel()
    weights = np.full((dim, 12), 0.1)
    weights[:, ::2] += np.arange(dim)[:, None] / dim
    return weights @ means / np.linalg.norm(weights @ means)


def test_an_entry_encodes_as_its_model_says(tmp_path, capfd):
    record = pull(tmp_path)
    assert (record.encoding_dim, record.input_size, record.beside) == (8, SIZE, {})
    capfd.readouterr()
    extractor = load(tmp_path)
    assert capfd.readouterr() == ("", "")
    images = [np.ascontiguousarray(np.random.default_rng(i).integers(0, 255, (42, 28, 3), np.uint8)) for i in range(3)]
    encodings = extractor.encode(images)
    assert encodings.dtype == np.float32
    np.testing.assert_allclose(encodings, [by_hand(image) for image in images], atol=3e-4)
    assert (extractor.encoding_dim, extractor.input_size) == (8, SIZE)
    by_name = make_evaluator(  # which may be in capitals
        evaluator_config({"kind": "feature_l2", "extractor": "torchhub:SOMEONE/places:entry"}),
        Compute(weights_dir=tmp_path, device=Device.CPU),
    )
    np.testing.assert_array_equal(by_name.encode(images), encodings)
    assert by_name.weights_sha256 == extractor.weights_sha256 == record.weights_sha256


@pytest.mark.parametrize(
    ("entry", "arguments"), [("entry", {"form": form}) for form in ("tensor", "pair", "zero")] + [("wrapped", {})]
)
def test_encodings_have_unit_length_and_stand_for_themselves(tmp_path, entry, arguments):
    """So are those of several outputs, of one that sees nothing, and of a model for several devices."""
    pull(tmp_path, entry, arguments=arguments)
    extractor = load(tmp_path, entry, largest_batch=2)
    encodings = extractor.encode(scenes())
    np.testing.assert_allclose(np.linalg.norm(encodings, axis=1), 1, rtol=1e-3)
    np.testing.assert_allclose(encodings, [extractor.encode([image])[0] for image in scenes()], atol=3e-4)


def test_by_itself_it_is_computed_in_float32(tmp_path):
    pull(tmp_path)
    by_itself, in_float32 = load(tmp_path).encode(scenes()), load(tmp_path, runtime=Runtime.TORCH).encode(scenes())
    np.testing.assert_array_equal(by_itself, in_float32)
    with contextlib.suppress(InvalidWeightsError):  # a model may be unable to; this one is not
        np.testing.assert_allclose(load(tmp_path, runtime=Runtime.TORCH_BF16).encode(scenes()), in_float32, atol=0.05)


@pytest.mark.parametrize(
    ("entry", "arguments", "message"),
    [
        ("entry", {"form": "dict"}, "gives dict for 2 images"),
        ("entry", {"form": "map"}, r"gives \[2, 3, 42, 28\] for 2 images"),
        ("entry", {"form": "one"}, r"gives \[1, 8\] for 2 images"),
        ("entry", {"form": "flat"}, r"gives \[8\] for 2 images"),
        ("entry", {"form": "whole"}, r"gives \[2, 8\] for 2 images"),
        ("entry", {"form": "nan"}, "NaN or infinity"),
        ("entry", {"form": "other"}, "does not take images of 28 x 42: KeyError"),
        ("entry", {"colour": "red"}, "cannot be made: TypeError"),
        ("broken", {}, "cannot be made: ValueError: there is nothing to see"),
        ("ending", {}, "cannot be made: SystemExit"),
        ("entry", {"dim": -1}, "cannot be made: RuntimeError"),
        ("text", {}, "gives a str, no model"),
        ("absent", {}, "Cannot find callable absent"),
        ("random", {}, "not the same each time"),
    ],
)
def test_what_gives_no_encodings_is_not_recorded(tmp_path, entry, arguments, message):
    with pytest.raises(InvalidWeightsError, match=message):
        pull(tmp_path, entry, arguments=arguments)
    assert not (tmp_path / LOCK).exists()
    with pytest.raises(MissingWeightsError, match=f"weights pull torchhub:{REPOSITORY}:{entry}"):
        load(tmp_path, entry)


@pytest.mark.parametrize("dim", [10**12, 10**15])
def test_a_model_that_does_not_fit_the_memory_is_no_invalid_one(tmp_path, dim):
    with pytest.raises(OutOfMemoryError):
        pull(tmp_path, arguments={"dim": dim})


@pytest.mark.parametrize("is_listed", [True, False])
def test_a_package_that_it_needs_is_named(tmp_path, is_listed):
    text = HUBCONF.replace('["torch"]', '["torch", "a_package_nobody_has"]') if is_listed else HUBCONF
    with pytest.raises(MissingPackageError, match="needs a_package_nobody_has"):
        pull(tmp_path, "entry" if is_listed else "needing", {"hubconf.py": text, "places_model.py": MODEL})


def test_a_module_that_the_repository_lacks_itself_is_no_package(tmp_path):
    model = MODEL.replace("import torch", "import torch\nfrom places_model.other import x", 1)
    with pytest.raises(InvalidWeightsError, match="cannot be made: ModuleNotFoundError"):
        pull(tmp_path, files={"hubconf.py": HUBCONF, "places_model.py": model})


def test_checkpoints_are_brought_by_a_pull_alone_and_recorded(tmp_path, monkeypatch):
    requests, url = [], "http://127.0.0.1:9/places.pth"
    checkpoint = tmp_path / "hub" / "checkpoints" / "places.pth"

    def fetch(url, target, tell, sha256=None, advice=""):
        requests.append((url, sha256))
        target.parent.mkdir(exist_ok=True)
        torch.save({"project.weight": torch.ones(8, 12)}, target)

    with pytest.raises(MissingWeightsError, match=rf"{url} cannot be reached.*{checkpoint}"):
        pull(tmp_path, "checkpoint")
    monkeypatch.setattr(downloads, "fetch", fetch)
    record = pull(tmp_path, "checkpoint")
    assert (requests, list(record.beside)) == ([(url, None)], ["checkpoints/places.pth"])
    sha256 = record.beside["checkpoints/places.pth"]
    np.testing.assert_allclose(np.abs(load(tmp_path, "checkpoint").encode(scenes())), 8**-0.5, rtol=1e-3)
    checkpoint.unlink()
    with pytest.raises(MissingWeightsError, match=r"places\.pth is missing"):
        load(tmp_path, "checkpoint")
    torch.save({"project.weight": torch.zeros(8, 12)}, checkpoint)
    for call, message in ((load, f"recorded with {sha256}"), (pull, "remove it")):
        with pytest.raises(InvalidWeightsError, match=message):
            call(tmp_path, "checkpoint")
    checkpoint.unlink()
    assert pull(tmp_path, "checkpoint") == record
    assert requests[1:] == [(url, sha256)]


def test_a_checkpoint_that_was_put_there_needs_no_network(tmp_path):
    checkpoints = tmp_path / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    torch.save({"project.weight": torch.ones(8, 12)}, checkpoints / "places.pth")
    assert list(pull(tmp_path, "checkpoint").beside) == ["checkpoints/places.pth"]


def test_loading_asks_nothing_of_a_network(tmp_path):
    """Neither an entry that swallows the first refusal, nor one whose record does not hold its download."""
    with pytest.raises(InvalidWeightsError, match="ConnectionRefusedError"):
        pull(tmp_path, "secret")
    record = pull(tmp_path)
    for entry, address in (("secret", "127.0.0.1"), ("checkpoint", "http://127.0.0.1:9/places.pth for ")):
        lock = Lock.read(tmp_path)
        lock.with_hub(f"torchhub:{REPOSITORY}:{entry}", replace(record, arguments={})).write()
        with pytest.raises(MissingWeightsError, match="nothing is downloaded while it is loaded") as error:
            load(tmp_path, entry)
        assert address in error.value.message


def test_other_repositories_that_it_loads_are_recorded_too(tmp_path, monkeypatch):
    """Torch hub has put one there; offline it is found by its folder's name."""
    inner = tmp_path / "hub" / "elsewhere_backbone_main"
    inner.mkdir(parents=True)
    (inner / "hubconf.py").write_text("from inner_model import Inner\n\ndef backbone():\n    return Inner()\n")
    (inner / "inner_model.py").write_text("from torch.nn import Identity as Inner\n")
    monkeypatch.setattr("torch.hub._parse_repo_info", lambda github: (*github.split("/"), "main"))
    record = pull(tmp_path, "nested")
    assert list(record.beside) == ["elsewhere_backbone_main"]
    assert load(tmp_path, "nested").encoding_dim == 8
    (inner / "README").write_text("changed")
    with pytest.raises(InvalidWeightsError, match="elsewhere_backbone_main has sha256"):
        load(tmp_path, "nested")


def test_repositories_may_have_modules_of_one_name(tmp_path):
    pull(tmp_path)
    files = {"hubconf.py": HUBCONF, "places_model.py": MODEL.replace("means)", "-means)")}
    leave_archive(tmp_path, files, "another/Places")
    pull_hub(tmp_path, HubWish("torchhub:another/Places:entry", COMMIT, input_size=SIZE), lambda *_: None)
    another = torchhub("another/Places:entry", Compute(weights_dir=tmp_path, device=Device.CPU))
    np.testing.assert_allclose(another.encode(scenes()), -load(tmp_path).encode(scenes()), atol=3e-4)


@pytest.mark.parametrize("change", ["changed", "added", "removed", "gone"])
def test_a_tree_that_was_changed_is_not_run(tmp_path, change):
    record = pull(tmp_path)
    tree, mark = tmp_path / "hub" / record.folder, tmp_path / "was-run"
    evil = f"open({str(mark)!r}, 'w')\n"
    changes = {
        "changed": lambda: (tree / "hubconf.py").write_text(evil + HUBCONF),
        "added": lambda: (tree / "torch.py").write_text(evil),
        "removed": (tree / "places_model.py").unlink,
        "gone": lambda: tree.rename(tmp_path / "elsewhere"),
    }
    changes[change]()
    with pytest.raises(MissingWeightsError if change == "gone" else InvalidWeightsError) as error:
        load(tmp_path)
    assert not mark.exists()
    assert record.folder in error.value.message
    assert change == "gone" or record.tree_sha256 in error.value.message
    assert pull(tmp_path) == record, "a pull mends it"
    assert load(tmp_path).encoding_dim == 8


def test_another_entry_of_a_repository_that_is_here_needs_no_archive(tmp_path):
    first = pull(tmp_path)
    wish = HubWish(f"torchhub:{REPOSITORY}:wrapped", commit=COMMIT, input_size=SIZE)
    second = pull_hub(tmp_path, wish, lambda *_: None)
    assert (second.tree_sha256, second.archive_sha256) == (first.tree_sha256, first.archive_sha256)


def test_an_archive_of_the_same_commit_must_be_the_same(tmp_path):
    record = pull(tmp_path)
    (tmp_path / "hub" / record.folder / "hubconf.py").write_text("")
    mark = tmp_path / "was-run"
    evil = {"hubconf.py": f"open({str(mark)!r}, 'w')\n{HUBCONF}", "places_model.py": MODEL}
    for parts, message in (({"files": evil}, record.tree_sha256), ({"sha256": "00000000"}, "should have 00000000")):
        with pytest.raises(InvalidWeightsError, match=message):
            pull(tmp_path, **parts)
    assert not mark.exists()
    assert pull(tmp_path) == record


def test_what_python_keeps_of_a_tree_is_neither_read_nor_counted(tmp_path):
    record = pull(tmp_path)
    tree = tmp_path / "hub" / record.folder
    assert not (tree / "__pycache__").exists()
    (tree / "__pycache__").mkdir()
    (tree / "__pycache__" / f"places_model.{sys.implementation.cache_tag}.pyc").write_bytes(b"no code at all")
    assert load(tmp_path).encoding_dim == 8


def test_the_dimension_that_is_known_must_come(tmp_path):
    pull(tmp_path)
    text = (tmp_path / LOCK).read_text()
    (tmp_path / LOCK).write_text(text.replace('"encoding_dim": 8', '"encoding_dim": 9'))
    with pytest.raises(InvalidWeightsError, match="encodings of 8 numbers, not 9"):
        load(tmp_path)


@pytest.mark.parametrize("text", ["", "{", '{"version": 2}', '{"hub": {"x": {}}}', '{"files": {"x": {"sha256": "1"}}}'])
def test_a_damaged_lock_is_named(tmp_path, text):
    (tmp_path / LOCK).write_text(text)
    with pytest.raises(InvalidWeightsError, match=r"weights\.lock is no lock"):
        load(tmp_path)
