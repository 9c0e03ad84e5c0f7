"""NetVLAD of every family against the paper's equations in numpy, on files of exactly the published layouts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.netvlad import netvlad
from deepsimbad.evaluators.extractors.network import NetworkExtractor
from deepsimbad.evaluators.nets.netvlad import NetVlad
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.evaluators.weights.netvlad_families import NetVladWeights, read_netvlad
from tests.evaluators import netvlad_reference as reference

FAMILIES = sorted(reference.WRITERS)
Image = NDArray[np.uint8]


def scene(height: int, width: int, seed: int = 0) -> Image:
    """[height, width, 3] uint8 of soft coloured blobs: places that differ, as in a photograph."""
    random = np.random.default_rng(seed)
    small = random.integers(0, 256, (1 + height // 12, 1 + width // 12, 3))
    image = np.kron(small, np.ones((12, 12, 1)))[:height, :width] + random.normal(0, 12, (height, width, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def cosine(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def extractor(path: Path, runtime: Runtime = Runtime.TORCH, largest_batch: int = 0) -> NetworkExtractor:
    return netvlad(path.name, Compute(runtime, Device.CPU, largest_batch=largest_batch, weights_dir=path.parent))


def encoded(module: NetVlad, image: Image) -> NDArray[np.float32]:
    with torch.inference_mode():
        return np.asarray(module.eval()(torch.from_numpy(image[None]))[0].numpy())


def written(folder: Path, family: str, **options: Any) -> tuple[Path, reference.Network]:
    network = reference.random_network(family, **options)
    path = folder / f"{family}.weights"
    reference.WRITERS[family](path, network)
    return path, network


@pytest.mark.parametrize(("runtime", "least"), [(Runtime.TORCH, 0.9999), (Runtime.TORCH_BF16, 0.999)])
@pytest.mark.parametrize("family", FAMILIES)
def test_agrees_with_the_equations(tmp_path: Path, family: str, runtime: Runtime, least: float) -> None:
    path, network = written(tmp_path, family)
    made = extractor(path, runtime)
    image = scene(480, 640) if made.input_size else scene(90, 118)
    found = made.encode([image])
    assert found.shape == (1, made.encoding_dim)
    assert np.linalg.norm(found[0]) == pytest.approx(1.0, abs=1e-3)
    assert cosine(found[0], reference.encoding(network, image)) > least


@pytest.mark.parametrize("family", FAMILIES)
def test_each_family_is_recognised_by_what_its_file_holds(tmp_path: Path, family: str) -> None:
    path, network = written(tmp_path, family)
    weights = read_netvlad(path)
    assert weights.preset.family == family
    assert weights.preset.cluster_major is network.cluster_major
    size = extractor(path).input_size
    assert size == (None if family == "matlab" else (640, 480))


def wrongly(weights: NetVladWeights, **changes: Any) -> NetVladWeights:
    return replace(weights, preset=replace(weights.preset, **changes))


# The next three show that the comparison above would find the mistake: without an error, the encoding is another one.


@pytest.mark.parametrize("family", FAMILIES)
def test_a_wrong_order_is_found(tmp_path: Path, family: str) -> None:
    path, network = written(tmp_path, family)
    weights = read_netvlad(path)
    image = scene(90, 118)
    expected = reference.encoding(network, image)
    assert cosine(encoded(weights.module(), image), expected) > 0.9999
    wrong = wrongly(weights, cluster_major=not weights.preset.cluster_major)
    assert cosine(encoded(wrong.module(), image), expected) < 0.9


@pytest.mark.parametrize("family", ["matlab", "patch_netvlad", "openibl"])
def test_a_missing_whitening_is_found(tmp_path: Path, family: str) -> None:
    path, network = written(tmp_path, family, n_outputs=60)  # as many as there are without one: lengths would tell
    weights = read_netvlad(path)
    image = scene(90, 118)
    expected = reference.encoding(network, image)
    assert cosine(encoded(weights.module(), image), expected) > 0.9999
    without = {name: tensor for name, tensor in weights.tensors.items() if not name.startswith("whitening")}
    found = encoded(replace(weights, tensors=without).module(), image)
    assert found.shape == expected.shape
    assert cosine(found, expected) < 0.9


@pytest.mark.parametrize("name", ["mean", "deviation"])
@pytest.mark.parametrize("family", FAMILIES)
def test_another_familys_pixels_are_found(tmp_path: Path, family: str, name: str) -> None:
    path, network = written(tmp_path, family)
    weights = read_netvlad(path)
    image = scene(90, 118)
    expected = reference.encoding(network, image)
    of_another = {"mean": torch.tensor([0.485, 0.456, 0.406]), "deviation": 2 * weights.tensors["deviation"]}
    wrong = replace(weights, tensors={**weights.tensors, name: of_another[name]})
    assert cosine(encoded(wrong.module(), image), expected) < 0.999


def test_red_and_blue_swapped_are_found(tmp_path: Path) -> None:
    path, network = written(tmp_path, "matlab")
    image = scene(90, 118)
    found = encoded(read_netvlad(path).module(), np.ascontiguousarray(image[..., ::-1]))
    assert cosine(found, reference.encoding(network, image)) < 0.999


def test_names_of_several_devices(tmp_path: Path) -> None:
    network = reference.random_network("pytorch_netvlad")
    reference.write_parallel(tmp_path / "parallel", network)
    reference.write_pytorch_netvlad(tmp_path / "alone", network)
    image = scene(64, 80)
    parallel, alone = (encoded(read_netvlad(tmp_path / name).module(), image) for name in ("parallel", "alone"))
    np.testing.assert_array_equal(parallel, alone)


def test_double_precision_is_brought_to_single(tmp_path: Path) -> None:
    """Patch-NetVLAD makes its whitening in numpy, in double precision."""
    network = reference.random_network("patch_netvlad")
    assert network.whitening is not None
    doubled = torch.from_numpy(network.whitening.astype(np.float64))[:, :, None, None]
    reference.write_patch_netvlad(tmp_path / "double", network, **{"WPCA.0.weight": doubled})
    assert {tensor.dtype for tensor in read_netvlad(tmp_path / "double").tensors.values()} == {torch.float32}


def test_matlabs_aspect_is_kept_and_the_longer_side_reduced_to_1024(tmp_path: Path) -> None:
    path, _ = written(tmp_path, "matlab")
    made = extractor(path)
    assert made.prepare(scene(60, 100)).shape == (60, 100, 3)
    assert made.prepare(scene(700, 1400)).shape == (512, 1024, 3)
    assert made.prepare(scene(4, 300)).shape == (16, 300, 3)  # of fewer rows nothing would be left
    assert np.isfinite(made.encode([scene(1, 1), scene(3, 2000)])).all()


def test_images_of_several_sizes_in_one_call(tmp_path: Path) -> None:
    path, network = written(tmp_path, "matlab")
    images = [scene(80, 96, 1), scene(80, 96, 2), scene(48, 64, 3), scene(80, 96, 4)]
    found = extractor(path, largest_batch=4).encode(images)
    for row, image in zip(found, images, strict=True):
        assert cosine(row, reference.encoding(network, image)) > 0.9999


def test_a_uniform_image_has_an_encoding(tmp_path: Path) -> None:
    for family in FAMILIES:
        path, _ = written(tmp_path, family)
        found = extractor(path).encode([np.full((64, 64, 3), 128, np.uint8)])
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-3)


def test_weights_laid_out_for_the_processor_are_made_anew_after_a_cast(tmp_path: Path) -> None:
    path, network = written(tmp_path, "matlab")
    image = scene(64, 80)
    module = read_netvlad(path).module().requires_grad_(False)
    expected = reference.encoding(network, image)
    assert cosine(encoded(module, image), expected) > 0.9999
    module.trunk.to(torch.bfloat16)
    assert cosine(encoded(module, image), expected) > 0.999
    with torch.no_grad():
        first = next(module.trunk.parameters())
        first.data = torch.zeros_like(first)
    assert cosine(encoded(module, image), expected) < 0.999


def test_as_a_configuration_names_it(tmp_path: Path) -> None:
    path, network = written(tmp_path, "matlab")
    config = evaluator_config({"kind": "feature_l2", "extractor": f"netvlad:{path.name}"})
    evaluator = make_evaluator(config, Compute(Runtime.TORCH, Device.CPU, weights_dir=tmp_path))
    image = scene(64, 80)
    assert evaluator.encoding_dim == 16
    assert evaluator.input_size is None
    assert evaluator.weights_sha256 is not None
    assert cosine(evaluator.encode([image])[0], reference.encoding(network, image)) > 0.9999


@pytest.mark.slow
@pytest.mark.parametrize("family", ["matlab", "patch_netvlad"])
def test_full_shapes(tmp_path: Path, family: str) -> None:
    """64 clusters of 512 numbers, 4,096 left of them: half a gigabyte, as the published files."""
    network = reference.random_network(family, reference.FULL, n_clusters=64, n_outputs=4096)
    image = scene(96, 128)
    expected = reference.encoding(network, image, np.float32)
    path = tmp_path / "full.weights"
    if family == "matlab":
        reference.write_matlab(path, network, compressed=False)
    else:
        reference.write_patch_netvlad(path, network)
    del network
    weights = read_netvlad(path)
    assert weights.encoding_dim == 4096
    module = weights.module()
    assert cosine(encoded(module, image), expected) > 0.9999
    module.trunk.to(torch.bfloat16)
    assert cosine(encoded(module, image), expected) > 0.999
    path.unlink()
