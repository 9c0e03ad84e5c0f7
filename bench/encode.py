"""How long encoding takes: the default extractor by every runtime, and sixteen robots that post images at once.

    python -m bench.encode

Writes docs/results/encode.md. All rows of a table are measured in turn in one process, so that they share whatever else
the machine does; medians count.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch

from bench.link import Link
from bench.measurement import RESULTS, Command, Timing, interleaved, machine, markdown, print_page, timed, work_folder
from bench.robots import LiveRobot, Waits, drive, grainy_jpegs
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.extractors.base import resized
from deepsimbad.evaluators.extractors.efficientnet_lite0 import EfficientNetLite0
from deepsimbad.evaluators.extractors.gradient_grid import GradientGrid
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator, make_extractor
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

RUNTIMES = (Runtime.TORCH, Runtime.TORCH_BF16, Runtime.ONNXRUNTIME)
N_ROBOTS, N_VIEWS = 16, 60
_DOMAIN = "street"


def medians_ms(work: dict[str, Callable[[], object]], rounds: int = 60) -> dict[str, float]:
    """Median milliseconds of every piece of work, measured in turn."""
    timings = interleaved(list(work.values()), rounds, warm_up=5)
    return {name: 1000 * timing.median_s for name, timing in zip(work, timings, strict=True)}


def by_runtime(bodies: list[bytes]) -> Iterator[str]:
    """Lines on the time from JPEG to encoding, whole and in parts, by runtime."""
    yield from ("## One image, 640 x 480 JPEG to encoding", "")
    images, rows = [decode_image(body, 10**7) for body in bodies], []
    exact = make_extractor("efficientnet_lite0", Compute(runtime=Runtime.TORCH)).encode(images)
    for runtime in RUNTIMES:
        extractor: EfficientNetLite0 = make_extractor("efficientnet_lite0", Compute(runtime=runtime))  # type: ignore[assignment]
        network = extractor._network
        prepared = [network.prepare(images[0])]
        work = {
            "whole": lambda extractor=extractor: extractor.encode([decode_image(bodies[0], 10**7)]),
            "network": lambda network=network, prepared=prepared: network.encode(prepared),
            "bare": _bare(network.run, np.stack(prepared)),
        }
        whole_ms, network_ms, bare_ms = medians_ms(work).values()
        cosine = float(np.einsum("nd,nd->n", extractor.encode(images), exact).min())
        share = f"{100 * bare_ms / network_ms:.0f} %"
        rows.append([runtime.value, f"{whole_ms:.1f}", f"{network_ms:.1f}", f"{bare_ms:.1f}", share, f"{cosine:.5f}"])
    times = ("whole, ms", "the network through the extractor, ms", "the bare runtime, ms")
    yield from markdown(("runtime", *times, "of its throughput", "cosine with torch, least"), rows)
    yield ""
    yield (
        "At most 12 ms were asked for, whole. ONNX Runtime is an extra: where it is not installed and the processor "
        "has no units for bfloat16, the first row counts."
    )
    yield ""


def _bare(run: object, pixels: np.ndarray) -> Callable[[], object]:
    """The runtime's own call on pixels at hand, with nothing of ours around it."""
    if hasattr(run, "_session"):
        session = run._session
        return lambda: session.run(None, {"pixels": pixels})
    module, tensor = run._module, torch.from_numpy(pixels)  # type: ignore[attr-defined]

    def call() -> object:
        with torch.inference_mode():
            return module(tensor)

    return call


def in_parts(bodies: list[bytes]) -> Iterator[str]:
    """Lines on the time of the steps around the network."""
    image = decode_image(bodies[0], 10**7)
    upright, small, gradients = np.ascontiguousarray(image), resized(image, (224, 224)), GradientGrid()
    took = medians_ms(
        {
            "decode": lambda: decode_image(bodies[0], 10**7),
            "rotate (recordings that lie on their side)": lambda: cv2.rotate(upright, cv2.ROTATE_90_CLOCKWISE),
            "resize to 224 x 224": lambda: resized(image, (224, 224)),
            "gradient grid": lambda: gradients.encode([small]),
        }
    )
    yield from markdown(("part", "ms"), [(name, f"{ms:.2f}") for name, ms in took.items()])
    yield ""


def batches() -> Iterator[str]:
    """Lines on what a larger batch is worth on this machine."""
    yield from ("## Batches", "", "Milliseconds an image, the network through the extractor:", "")
    pixels, rows = [np.random.default_rng(k).integers(0, 256, (224, 224, 3), np.uint8) for k in range(16)], []
    for runtime in RUNTIMES:
        computes = [Compute(runtime=runtime, largest_batch=n_images) for n_images in (1, 2, 4, 8, 16)]
        networks = [make_extractor("efficientnet_lite0", compute)._network for compute in computes]  # type: ignore[attr-defined]
        runs = [lambda network=network: network.encode(pixels) for network in networks]
        rows.append(
            [runtime.value, *(f"{1000 * timing.median_s / 16:.1f}" for timing in interleaved(runs, 8, warm_up=5))]
        )
    yield from markdown(("runtime", "1", "2", "4", "8", "16"), rows)
    yield from (
        "",
        "ONNX Runtime works on every image with one thread, on as many as there are cores; PyTorch with all threads on "
        "one. Where `DEEPSIMBAD_ENCODE_BATCH` is not set, it is 1 for PyTorch on the processor, where a batch rounds "
        "otherwise than one image, four a core for ONNX Runtime, and 32 on CUDA.",
        "",
    )


def robots(bodies: list[bytes]) -> Iterator[str]:
    """Lines on sixteen robots against one service, beside what the same machine encodes without one."""
    loop_rate = _own_rate(bodies)
    with work_folder() as folder, LocalServer(folder / "data") as server:
        with Link(server.url) as link:
            link.ask("PUT", f"/v1/admin/domains/{_DOMAIN}", {"evaluator": {"kind": "feature_l2"}})
            dim = link.ask("GET", f"/v1/domains/{_DOMAIN}")["encoding_dim"]
            encodings = np.random.default_rng(1).normal(size=(1000, dim)).astype(np.float32)
            link.upload(_DOMAIN, "drive", np.arange(1000.0), encodings)
            drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
            link.remap(_DOMAIN, {**drives, "n_landmarks": 300, "training_episodes": 0})
        crowd = [LiveRobot("", _DOMAIN, bodies[k:] + bodies[:k], "image/jpeg") for k in range(N_ROBOTS)]

        def is_over(waits: Waits) -> bool:
            return len(waits.seconds) + 1 >= N_VIEWS

        drive(server.url, crowd[:1], is_over)  # warms up
        (alone,) = drive(server.url, crowd[:1], is_over)
        start_s = time.perf_counter()
        together = drive(server.url, crowd, is_over)
        rate = N_ROBOTS * N_VIEWS / (time.perf_counter() - start_s)
    if failures := [failure for waits in together for failure in waits.failures]:
        raise RuntimeError(f"not every image was answered: {failures}")
    rates = [N_VIEWS / sum(waits.seconds) for waits in together]
    spread = 1000 * np.quantile([second for waits in together for second in waits.seconds], (0.5, 0.99))
    alone_ms = 1000 * np.quantile(alone.seconds, (0.5, 0.99))
    yield from (
        f"## {N_ROBOTS} robots that post 640 x 480 JPEGs at once",
        "",
        "Each posts its next view when the last was answered, 1,000 map images, localizations with the whole answer.",
        "",
    )
    rows = {
        "the same JPEGs in a loop without a service, decoding a batch ahead": f"{loop_rate:.0f} images a second",
        f"{N_ROBOTS} robots over HTTP": f"{rate:.0f} answers a second, {100 * rate / loop_rate:.0f} % of that",
        "a robot's own rate, slowest and fastest": f"{min(rates):.1f} and {max(rates):.1f} a second",
        "time of an answer, median and p99": f"{spread[0]:.0f} and {spread[1]:.0f} ms",
        "one robot alone, median and p99": f"{alone_ms[0]:.1f} and {alone_ms[1]:.1f} ms",
    }
    yield from markdown(("", ""), rows.items())
    yield from (
        "",
        "The loop uses both cores as well as it can: while the network works on one image the next is decoded. The "
        "robots, and the HTTP they speak, run on the same two cores as the service.",
        "",
    )


def _own_rate(bodies: list[bytes]) -> float:
    evaluator: Evaluator = make_evaluator(evaluator_config({"kind": "feature_l2"}))
    evaluator.load()
    n_images, largest = 300, evaluator.largest_batch

    def prepared(k: int) -> np.ndarray:
        return evaluator.prepare(decode_image(bodies[k % len(bodies)], 10**7))

    def loop() -> None:
        following = [ahead.submit(prepared, k) for k in range(largest)]
        for first in range(0, n_images, largest):
            images = [future.result() for future in following]
            following = [ahead.submit(prepared, first + k) for k in range(largest)]
            evaluator.encode(images)

    with ThreadPoolExecutor(2) as ahead:
        return n_images / timed(loop, 3, warm_up=0).median_s


def starts() -> Iterator[str]:
    """Lines on the time from the command to `/readyz`, with a domain of the default extractor."""
    yield from ("## Start", "")
    imported_s, rows = {}, []
    for name in ("torch", "onnxruntime", "sys"):
        command = [sys.executable, "-c", f"import {name}"]
        imported_s[name] = timed(lambda: subprocess.run(command, check=True), 3, warm_up=0).median_s  # noqa: B023, S603
    for runtime in (Runtime.TORCH, Runtime.ONNXRUNTIME):
        with work_folder() as folder:
            server = LocalServer(folder / "data", environment={"DEEPSIMBAD_NETWORK_RUNTIME": runtime.value})
            with server, Client(server.url) as client:
                client.admin.put_domain(_DOMAIN, {"kind": "feature_l2"})
            seconds = []
            for _ in range(5):
                start_s = time.perf_counter()
                server.start()
                seconds.append(time.perf_counter() - start_s)
                server.stop()
        rows.append((f"{Timing(seconds).median_s:.2f}", runtime.value))
    yield from markdown(("to `/readyz`, median of five, s", "runtime"), rows)
    yield from (
        "",
        f"Of which importing torch alone takes {imported_s['torch'] - imported_s['sys']:.2f} s, ONNX Runtime "
        f"{imported_s['onnxruntime'] - imported_s['sys']:.2f} s. The very first start with ONNX Runtime prepares "
        "the network besides, some seconds, unless `deepsimbad` did so before on this machine.",
    )


def report() -> Iterator[str]:
    """The lines of the page."""
    bodies = grainy_jpegs(24)
    yield from ("# Encoding", "", "Made by `python -m bench.encode`.", "", machine(), "")
    yield from (f"The default extractor, `efficientnet_lite0`; JPEGs of {len(bodies[0]) // 1000} kB.", "")
    for part in (by_runtime(bodies), in_parts(bodies), batches(), robots(bodies), starts()):
        yield from part


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report(), RESULTS / "encode.md"))
