"""ONNX files of anybody's making, written here with onnx.helper."""

import hashlib

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors import onnx_file as module
from deepsimbad.evaluators.extractors.onnx_file import onnx_file
from deepsimbad.evaluators.weights.lock import FileRecord, Lock

D = 6
WEIGHTS = np.random.default_rng(3).normal(size=(3, D)).astype(np.float32)


def model(
    shape=("n", 3, 20, 30), *, nodes=None, output=("n", D), kind=TensorProto.FLOAT, metadata=None, opsets=(("", 17),),
    axes=(2, 3),
):  # fmt: skip
    """Means over rows and columns, times a matrix: [n, 3, h, w] to [n, 6]."""
    nodes = nodes or [
        helper.make_node("ReduceMean", ["x"], ["means"], axes=list(axes), keepdims=0),
        helper.make_node("MatMul", ["means", "weights"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes, "g", [helper.make_tensor_value_info("x", kind, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, output)],
        [numpy_helper.from_array(WEIGHTS, "weights")],
    )  # fmt: skip
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid(*opset) for opset in opsets], ir_version=9)
    helper.set_model_props(proto, {f"deepsimbad.{name}": text for name, text in (metadata or {}).items()})
    return proto


def load(folder, content, **compute):
    (folder / "places.onnx").write_bytes(content if isinstance(content, bytes) else content.SerializeToString())
    return onnx_file("places.onnx", Compute(weights_dir=folder, **compute))


def images(n=3, size=(20, 30)):
    return list(np.random.default_rng(1).integers(0, 256, (n, *size, 3), np.uint8))


def by_hand(images, scale=1 / 255, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225), bgr=False):
    means = np.stack([image.astype(np.float64).mean(axis=(0, 1)) for image in images])
    means = means if bgr else means[:, ::-1]
    vectors = ((means * scale - mean) / std) @ WEIGHTS
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        (("n", 3, 20, 30), (30, 20)),
        (("n", 3, "h", "w"), (224, 224)),
        ((None, 3, None, None), (224, 224)),
        (("n", 3, "h", 100), (100, 224)),
        ((1, 3, 20, 30), (30, 20)),
    ],
)
def test_a_file_encodes_as_its_graph_says_which_may_leave_sides_and_batches_open(tmp_path, shape, size):
    assert load(tmp_path, model()).largest_batch == 1, "unless told"
    extractor = load(tmp_path, model(shape, output=(shape[0], D)), largest_batch=4)
    largest_batch = 1 if shape[0] == 1 else 4
    assert (extractor.input_size, extractor.encoding_dim, extractor.largest_batch) == (size, D, largest_batch)
    scenes = images(size=size[::-1])
    encodings = extractor.encode(scenes)
    assert encodings.dtype == np.float32
    np.testing.assert_allclose(encodings, by_hand(scenes), atol=1e-3)
    assert extractor.weights_sha256 == hashlib.sha256((tmp_path / "places.onnx").read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("metadata", "parts"),
    [
        (
            {"mean": "[0.5, 0.4, 0.3]", "std": "[1, 2, 3]", "scale": "0.01", "channels": "BGR"},
            {"scale": 0.01, "mean": (0.5, 0.4, 0.3), "std": (1, 2, 3), "bgr": True},
        ),
        (
            {"mean": "[123, 117, 104]", "std": "[1, 1, 1]", "scale": "[1, 1, 1]", "layout": "NHWC"},
            {"scale": 1, "mean": (123, 117, 104), "std": (1, 1, 1)},
        ),
        ({"channels": "BGR"}, {"mean": (0.406, 0.456, 0.485), "std": (0.225, 0.224, 0.229), "bgr": True}),
    ],
    ids=str,
)
def test_how_images_are_shown_is_told_by_the_file(tmp_path, metadata, parts):
    layout = {"shape": ("n", 20, 30, 3), "axes": (1, 2)} if "layout" in metadata else {}
    extractor = load(tmp_path, model(**layout, metadata=metadata))
    np.testing.assert_allclose(extractor.encode(images()), by_hand(images(), **parts), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *(("mean", text) for text in ("[1, 2]", "[1, 2, NaN]", "red", "[1, 2, true]", "[1, 2, 1e300]")),
        *(("means", "[1, 2, 3]"), ("std", "[1, 0, 1]"), ("scale", "[]"), ("scale", "[[1]]")),
        *(("channels", "GBR"), ("layout", "nchw")),
    ],
)
def test_metadata_that_means_nothing_is_refused(tmp_path, name, text):
    with pytest.raises(InvalidWeightsError, match=f"deepsimbad.{name}"):
        load(tmp_path, model(metadata={name: text}))


MEANS = helper.make_node("ReduceMean", ["x"], ["means"], axes=[2, 3], keepdims=0)


def test_maps_of_one_cell_are_encodings_and_where_nothing_is_seen_they_are_neutral(tmp_path):
    nodes = [helper.make_node("GlobalAveragePool", ["x"], ["y"])]
    assert load(tmp_path, model(nodes=nodes, output=("n", 3, 1, 1))).encode(images()).shape == (3, 3)
    nodes = [MEANS, helper.make_node("Sub", ["means", "means"], ["y"])]
    encodings = load(tmp_path, model(nodes=nodes, output=("n", 3))).encode(images())
    np.testing.assert_allclose(encodings, 3**-0.5, atol=1e-3)


def _node(name, *inputs, **attributes):
    return [helper.make_node(name, list(inputs), ["y"], **attributes)]


@pytest.mark.parametrize(
    ("make_file", "message"),
    [
        (lambda: model(("n", 1, 20, 30), nodes=_node("Identity", "x"), output=("n", 1, 20, 30)), "takes tensor"),
        (lambda: model(("n", 20, 30, 3), axes=(1, 2)), "takes tensor"),
        (lambda: model((4, 3, 20, 30), output=(4, D)), "with n open or 1"),
        (lambda: model(("n", 3, 20, 100_000)), "takes tensor"),
        (lambda: model(("n", 3, 20), nodes=_node("Identity", "x"), output=("n", 3, 20)), "takes tensor"),
        (lambda: model(kind=TensorProto.DOUBLE), "."),
        (lambda: model(nodes=_node("Identity", "x"), output=("n", 3, 20, 30)), r"gives \[1, 3, 20, 30\] for 1 images"),
        (lambda: model(nodes=_node("Shape", "x"), output=(4,)), "."),
        (lambda: model(nodes=_node("MatMul", "x", "weights")), "."),
        (lambda: model(nodes=_node("Sight", "x", domain="others"), opsets=(("", 17), ("others", 1))), "can run"),
        (lambda: model(nodes=[MEANS, helper.make_node("Sub", ["means", "means"], ["none"]),
                              *_node("Div", "means", "none")], output=("n", 3)), "NaN, infinity"),
        (lambda: model().SerializeToString()[:-40], "."),
        (lambda: model().SerializeToString()[:50], "."),
        (lambda: b"", "no whole ONNX file"),
        (lambda: b"no model at all", "no whole ONNX file"),
        (lambda: b"\x00" * 1000, "no whole ONNX file"),
    ],
)  # fmt: skip
def test_what_gives_no_encodings_is_refused(tmp_path, capfd, make_file, message):
    with pytest.raises(InvalidWeightsError, match=message) as refused:
        load(tmp_path, make_file())
    assert "places.onnx" in refused.value.message
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("location", ["initializer", "constant", "branch"])
def test_data_in_another_file_is_refused(tmp_path, location):
    proto = model()
    outside = onnx.TensorProto(name="weights", data_type=TensorProto.FLOAT, dims=[3, D])
    outside.data_location = TensorProto.EXTERNAL
    outside.external_data.add(key="location", value="../secret")
    if location == "initializer":
        proto.graph.initializer[0].CopyFrom(outside)
    else:
        constant = helper.make_node("Constant", [], ["c"], value=outside)
        if location == "branch":
            branch = helper.make_graph(
                [constant], "b", [], [helper.make_tensor_value_info("c", TensorProto.FLOAT, (3, D))]
            )
            constant = helper.make_node("If", ["when"], ["c"], then_branch=branch, else_branch=branch)
        proto.graph.node.append(constant)
    with pytest.raises(InvalidWeightsError, match="keeps its numbers in another file"):
        load(tmp_path, proto)


def test_a_file_is_held_to_what_was_recorded(tmp_path):
    load(tmp_path, model())
    Lock.read(tmp_path).with_file("places.onnx", FileRecord("0" * 64, 5, "onnx:places.onnx")).write()
    with pytest.raises(InvalidWeightsError, match="was changed"):
        load(tmp_path, model())


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    with pytest.raises(MissingWeightsError, match=r"put it at .*places\.onnx"):
        onnx_file("places.onnx", Compute(weights_dir=tmp_path))
    monkeypatch.setattr(module, "has_onnxruntime", lambda: False)
    with pytest.raises(MissingPackageError, match=r"deep-simbad\[fast\]"):
        onnx_file("places.onnx", Compute(weights_dir=tmp_path))
