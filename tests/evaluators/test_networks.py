"""NetVLAD and SqueezeNet of every family against the papers in numpy, on files of exactly the published layouts."""

import numpy as np
import pytest
import torch

from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.netvlad import netvlad, read_netvlad
from deepsimbad.evaluators.extractors.squeezenet import CELLS, ENCODING_DIM, OUTPUT_FIRES, read_squeezenet, squeezenet
from deepsimbad.evaluators.nets.squeezenet import SqueezeNet
from deepsimbad.evaluators.runtimes import has_onnxruntime

from . import references
from .references import (
    FIRES,
    NETVLAD_WRITERS,
    SIDES,
    SQUEEZENET_WRITERS,
    cosine,
    netvlad_encoding,
    random_network,
    random_squeezenet,
    scene,
    squeezenet_maps,
    unit,
)

FAMILIES = sorted(NETVLAD_WRITERS)
PRECISIONS = [(Runtime.TORCH, 0.9999), (Runtime.TORCH_BF16, 0.999)]


def load(make, path, runtime=Runtime.TORCH, largest_batch=0):
    return make(path.name, Compute(runtime, Device.CPU, largest_batch=largest_batch, weights_dir=path.parent))


def encode(module, image):
    with torch.inference_mode():
        return module.eval()(torch.from_numpy(image[None]))[0].numpy()


def write_network(folder, family, **options):
    network = random_network(family, **options)
    path = folder / f"{family}.weights"
    NETVLAD_WRITERS[family](path, network)
    return path, network


@pytest.mark.parametrize("family", FAMILIES)
def test_netvlad_agrees_with_the_equations(tmp_path, family):
    path, network = write_network(tmp_path, family)
    weights = read_netvlad(path)
    assert weights.preset.family == family
    # Said apart, since a random network hardly feels another family's mean, or one in BGR.
    assert weights.tensors["mean"].tolist() == pytest.approx(network.mean)
    assert weights.tensors["deviation"].tolist() == pytest.approx(network.deviation)
    image = scene(90, 118) if family == "matlab" else scene(480, 640)
    expected = netvlad_encoding(network, image, np.float32)
    for runtime, least_cosine in PRECISIONS:
        extractor = load(netvlad, path, runtime)
        assert extractor.input_size == (None if family == "matlab" else (640, 480))
        encodings = extractor.encode([image])
        assert encodings.shape == (1, extractor.encoding_dim)
        assert cosine(encodings[0], expected) > least_cosine


def test_names_of_several_devices(tmp_path):
    network, image = random_network("pytorch_netvlad"), scene(64, 80)
    references.write_pytorch_netvlad(tmp_path / "parallel", network, "module.")
    references.write_pytorch_netvlad(tmp_path / "alone", network)
    parallel, alone = (encode(read_netvlad(tmp_path / name).module(), image) for name in ("parallel", "alone"))
    np.testing.assert_array_equal(parallel, alone)


def test_double_precision_is_brought_to_single(tmp_path):
    """Patch-NetVLAD makes its whitening in numpy, in double precision."""
    network = random_network("patch_netvlad")
    doubled = torch.from_numpy(network.whitening.astype(np.float64))[:, :, None, None]
    references.write_patch_netvlad(tmp_path / "double", network, **{"WPCA.0.weight": doubled})
    assert {tensor.dtype for tensor in read_netvlad(tmp_path / "double").tensors.values()} == {torch.float32}


def test_matlabs_aspect_is_kept_and_the_longer_side_reduced_to_1024(tmp_path):
    path, network = write_network(tmp_path, "matlab")
    extractor = load(netvlad, path, largest_batch=4)
    assert extractor.prepare(scene(60, 100)).shape == (60, 100, 3)
    assert extractor.prepare(scene(700, 1400)).shape == (512, 1024, 3)
    assert extractor.prepare(scene(4, 300)).shape == (16, 300, 3)  # of fewer rows nothing would be left
    assert np.isfinite(extractor.encode([scene(1, 1), scene(3, 2000)])).all()
    images = [scene(80, 96, 1), scene(80, 96, 2), scene(48, 64, 3), scene(80, 96, 4)]
    for encoding, image in zip(extractor.encode(images), images, strict=True):
        assert cosine(encoding, netvlad_encoding(network, image)) > 0.9999


def test_weights_laid_out_for_the_processor_are_made_anew_after_a_cast(tmp_path):
    path, network = write_network(tmp_path, "matlab")
    image = scene(64, 80)
    module = read_netvlad(path).module().requires_grad_(False)
    expected = netvlad_encoding(network, image)
    assert cosine(encode(module, image), expected) > 0.9999
    module.trunk.to(torch.bfloat16)
    assert cosine(encode(module, image), expected) > 0.999
    with torch.no_grad():
        first = next(module.trunk.parameters())
        first.data = torch.zeros_like(first)
    assert cosine(encode(module, image), expected) < 0.999


@pytest.mark.slow
def test_full_shapes(tmp_path):
    """64 clusters of 512 numbers, 4,096 left of them: half a gigabyte, as the published files."""
    network, image, path = random_network("matlab", references.FULL, 64, 4096), scene(48, 64), tmp_path / "full"
    references.write_matlab(path, network, compressed=False)
    weights = read_netvlad(path)
    path.unlink()
    assert weights.encoding_dim == 4096
    assert cosine(encode(weights.module(), image), netvlad_encoding(network, image, np.float32)) > 0.9999


@pytest.fixture(scope="module")
def parameters():
    return random_squeezenet()


def squeezenet_encoding(parameters, image, family):
    maps = squeezenet_maps(parameters, image, family)
    return unit(np.concatenate([references.grid(maps[fire], *CELLS) for fire in OUTPUT_FIRES]))


@pytest.mark.parametrize("family", sorted(SQUEEZENET_WRITERS))
def test_squeezenet_agrees_with_the_papers_table(tmp_path, parameters, family):
    """Every fire module's map, and the encoding in both precisions."""
    path, image = tmp_path / "weights", scene(SIDES[family], SIDES[family])
    SQUEEZENET_WRITERS[family](path, parameters)
    weights, expected = read_squeezenet(path), squeezenet_maps(parameters, image, family)
    assert weights.preset.family == family
    pixels = image if family == "caffe" else image[..., ::-1]
    normalised = ((pixels - np.array(weights.preset.mean)) / np.array(weights.preset.std)).astype(np.float32)
    with torch.inference_mode():
        maps = weights.trunk(tuple(FIRES))(torch.from_numpy(normalised.transpose(2, 0, 1)[None]))
    for actual, (fire, expected_map) in zip(maps, expected.items(), strict=True):
        assert actual[0].shape == expected_map.shape, fire
        np.testing.assert_allclose(actual[0].numpy(), expected_map, rtol=1e-3, atol=1e-4 * expected_map.max())
    encoding = unit(np.concatenate([references.grid(expected[fire], *CELLS) for fire in OUTPUT_FIRES]))
    for runtime, least_cosine in PRECISIONS:
        extractor = load(squeezenet, path, runtime)
        assert (extractor.input_size, extractor.encoding_dim) == ((SIDES[family],) * 2, ENCODING_DIM)
        assert cosine(extractor.encode([image])[0], encoding) > least_cosine
    other = "torchvision" if family == "caffe" else "caffe"  # the comparison tells another family's pixels
    assert cosine(squeezenet_encoding(parameters, image, other), encoding) < 0.999
    assert len(SqueezeNet((4,)).fires) == 3, "only what is taken is computed"


@pytest.mark.slow
@pytest.mark.skipif(not has_onnxruntime(), reason="ONNX Runtime is not installed")
def test_squeezenet_in_onnxruntime_agrees(tmp_path, parameters):
    path, image = tmp_path / "weights", scene(227, 227)
    references.write_caffe(path, parameters)
    encodings = load(squeezenet, path, Runtime.ONNXRUNTIME).encode([image, image[::-1]])
    assert [file.suffix for file in (tmp_path / "exported").iterdir()] == [".onnx"]
    for encoding, expected in zip(encodings, load(squeezenet, path).encode([image, image[::-1]]), strict=True):
        assert cosine(encoding, expected) > 0.9999


@pytest.mark.real_data
def test_the_published_squeezenet(real_data):
    """Caffe's file as its authors trained it, against the reference."""
    path = real_data.parent / "weights" / "squeezenet1_0" / "squeezenet1_0_caffe.npz"
    if not path.is_file():
        pytest.skip(f"no weights at {path}")
    with np.load(path, allow_pickle=False) as arrays:
        published = {name: arrays[name] for name in arrays.files}
    image = scene(227, 227)
    expected = squeezenet_encoding(published, image, "caffe")
    for runtime, least_cosine in PRECISIONS:
        assert cosine(load(squeezenet, path, runtime).encode([image])[0], expected) > least_cosine
