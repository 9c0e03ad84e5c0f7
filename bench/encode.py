"""How long encoding takes: the default extractor by every runtime, and sixteen robots that post images at once.

    python -m bench.encode

Writes docs/results/encode.md. All rows of a table are measured in turn in one process, so that they share whatever else
the machine does; medians count.
"""

import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from pathlib import Path

import cv2
import numpy as np
import torch

from bench.common import RESULTS, describe
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.extractors.base import resized
from deepsimbad.evaluators.extractors.efficientnet_lite0 import EfficientNetLite0
from deepsimbad.evaluators.extractors.gradient_grid import GradientGrid
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator, make_extractor
from deepsimbad_client import Client
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.local_server import LocalServer

ROUNDS = 60
N_ROBOTS, N_VIEWS = 16, 60
_DOMAIN = "street"


def pictures(n: int) -> list[bytes]:
    """JPEGs of 640 x 480, about 90 kB each: smooth shapes with the grain of a camera."""
    rng = np.random.default_rng(0)
    bodies = []
    for _ in range(n):
        coarse = cv2.resize(rng.integers(0, 256, (24, 32, 3), np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
        grainy = np.clip(coarse + rng.normal(0, 6, coarse.shape), 0, 255).astype(np.uint8)
        bodies.append(cv2.imencode(".jpg", grainy, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())
    return bodies


def medians_ms(work: dict[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Milliseconds of each, measured in turn."""
    taken: dict[str, list[float]] = {name: [] for name in work}
    for round_ in range(rounds + 5):
        for name, run in work.items():
            began = time.perf_counter()
            run()
            if round_ >= 5:
                taken[name].append(1000 * (time.perf_counter() - began))
    return {name: statistics.median(times) for name, times in taken.items()}


def by_runtime(bodies: list[bytes]) -> Iterator[str]:
    """From JPEG to encoding, whole and in parts."""
    yield from (
        "## One image, 640 x 480 JPEG to encoding",
        "",
        "| runtime | whole, ms | the network through the extractor, ms | the bare runtime, ms | of its throughput "
        "| cosine with torch, least |",
        "|---|---|---|---|---|---|",
    )
    images = [decode_image(body, 10**7) for body in bodies]
    exact = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "efficientnet_lite0"}), _torch())
    wanted = exact.encode(images)
    for runtime in (Runtime.TORCH, Runtime.TORCH_BF16, Runtime.ONNXRUNTIME):
        extractor: EfficientNetLite0 = make_extractor("efficientnet_lite0", Compute(runtime=runtime))  # type: ignore[assignment]
        network = extractor._network
        shown = [network.prepare(image) for image in images]
        stacked = np.stack(shown[:1])
        bare = _bare(network.run, stacked)
        took = medians_ms(
            {
                "whole": lambda extractor=extractor: extractor.encode([decode_image(bodies[0], 10**7)]),
                "network": lambda network=network, shown=shown: network.encode(shown[:1]),
                "bare": bare,
            }
        )
        cosine = float(np.einsum("nd,nd->n", extractor.encode(images), wanted).min())
        yield (
            f"| {runtime.value} | {took['whole']:.1f} | {took['network']:.1f} | {took['bare']:.1f} "
            f"| {100 * took['bare'] / took['network']:.0f} % | {cosine:.5f} |"
        )
    yield ""


def _torch() -> Compute:
    return Compute(runtime=Runtime.TORCH)


def _bare(run: object, pixels: np.ndarray) -> Callable[[], object]:
    """The runtime's own call on pixels at hand, with nothing of ours around it."""
    if hasattr(run, "_session"):
        session = run._session
        return lambda: session.run(None, {"pixels": pixels})
    module, shown = run._module, torch.from_numpy(pixels)  # type: ignore[attr-defined]

    def call() -> object:
        with torch.inference_mode():
            return module(shown)

    return call


def in_parts(bodies: list[bytes]) -> Iterator[str]:
    """Where the rest of the time goes."""
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
    yield from ("| part | ms |", "|---|---|", *(f"| {name} | {ms:.2f} |" for name, ms in took.items()), "")


def batches() -> Iterator[str]:
    """What a larger batch is worth on this machine."""
    yield from (
        "## Batches",
        "",
        "Milliseconds an image, the network through the extractor:",
        "",
        "| runtime | 1 | 2 | 4 | 8 | 16 |",
        "|---|---|---|---|---|---|",
    )
    shown = [np.random.default_rng(k).integers(0, 256, (224, 224, 3), np.uint8) for k in range(16)]
    for runtime in (Runtime.TORCH, Runtime.TORCH_BF16, Runtime.ONNXRUNTIME):
        networks = {
            n: make_extractor("efficientnet_lite0", Compute(runtime=runtime, largest_batch=n))._network  # type: ignore[attr-defined]
            for n in (1, 2, 4, 8, 16)
        }
        took = medians_ms({str(n): lambda network=network: network.encode(shown) for n, network in networks.items()}, 8)
        yield f"| {runtime.value} | " + " | ".join(f"{ms / 16:.1f}" for ms in took.values()) + " |"
    yield from (
        "",
        "ONNX Runtime works on every image with one thread, on as many as there are cores; PyTorch with all threads on "
        "one. Where `DEEPSIMBAD_ENCODE_BATCH` is not set, it is 1 for PyTorch on the processor, where a batch rounds "
        "otherwise than one image, four a core for ONNX Runtime, and 32 on CUDA.",
        "",
    )


def robots(bodies: list[bytes]) -> Iterator[str]:
    """Sixteen robots against one service, beside what the same machine encodes with nothing around it."""
    own = _own_rate(bodies)
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder) / "data") as server:
        _make_domain(server.url, bodies)
        alone = _drive(server.url, bodies, 1)
        together = _drive(server.url, bodies, N_ROBOTS)
    rate = N_ROBOTS * N_VIEWS / together["seconds"]
    slowest, fastest = min(together["rates"]), max(together["rates"])
    yield from (
        f"## {N_ROBOTS} robots that post 640 x 480 JPEGs at once",
        "",
        "Each posts its next view when the last was answered, 1,000 map images, localizations with the whole answer.",
        "",
        "| | |",
        "|---|---|",
        f"| the same JPEGs in a loop without a service, decoding a batch ahead | {own:.0f} images a second |",
        f"| {N_ROBOTS} robots over HTTP | {rate:.0f} answers a second, {100 * rate / own:.0f} % of that |",
        f"| a robot's own rate, slowest and fastest | {slowest:.1f} and {fastest:.1f} a second |",
        f"| time of an answer, median and p99 | {together['median']:.0f} and {together['p99']:.0f} ms |",
        f"| one robot alone, median and p99 | {alone['median']:.1f} and {alone['p99']:.1f} ms |",
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

    rates = []
    with ThreadPoolExecutor(2) as ahead:
        for _ in range(3):
            began = time.perf_counter()
            following = [ahead.submit(prepared, k) for k in range(largest)]
            for first in range(0, n_images, largest):
                images = [each.result() for each in following]
                following = [ahead.submit(prepared, first + k) for k in range(largest)]
                evaluator.encode(images)
            rates.append(n_images / (time.perf_counter() - began))
    return statistics.median(rates)


def _make_domain(url: str, bodies: list[bytes]) -> None:
    with Client(url) as client:
        client.admin.put_domain(_DOMAIN, {"kind": "feature_l2"})
        dim = client.domain(_DOMAIN).encoding_dim or 0
        rng = np.random.default_rng(1)
        client.admin.create_traverse(_DOMAIN, "drive")
        values = rng.normal(size=(1000, dim)).astype(np.float16).astype(np.float32)
        client.admin.put_frames(_DOMAIN, "drive", encodings=values, index=range(1000), position_m=np.arange(1000.0))
        remap(client, _DOMAIN, "drive", landmark_traverse="drive", n_landmarks=300, training_episodes=0)
        client.localize(_DOMAIN, bodies[0])


def _drive(url: str, bodies: list[bytes], n_robots: int) -> dict[str, object]:
    """Robots as threads that do little but wait: plain connections, answers read and not looked into."""
    taken: list[float] = []
    rates: list[float] = []
    lock, start = threading.Lock(), threading.Barrier(n_robots + 1)

    def robot(number: int) -> None:
        own = []
        link = HTTPConnection(url.removeprefix("http://"), timeout=120)
        link.connect()
        start.wait()
        began = time.perf_counter()
        for view in range(N_VIEWS):
            asked = time.perf_counter()
            body = bodies[(number + view) % len(bodies)]
            link.request("POST", f"/v1/domains/{_DOMAIN}/localizations", body, {"Content-Type": "image/jpeg"})
            answer = link.getresponse()
            if answer.status != 200:
                raise RuntimeError(answer.read())
            answer.read()
            own.append(1000 * (time.perf_counter() - asked))
        rate = N_VIEWS / (time.perf_counter() - began)
        link.close()
        with lock:
            taken.extend(own)
            rates.append(rate)

    threads = [threading.Thread(target=robot, args=(number,)) for number in range(n_robots)]
    for thread in threads:
        thread.start()
    start.wait()
    began = time.perf_counter()
    for thread in threads:
        thread.join()
    return {
        "seconds": time.perf_counter() - began,
        "rates": rates,
        "median": float(np.median(taken)),
        "p99": float(np.percentile(taken, 99)),
    }


def starts() -> Iterator[str]:
    """From the command to `/readyz`, with a domain of the default extractor there."""
    yield from ("## Start", "", "| to `/readyz`, median of five, s | runtime |", "|---|---|")
    imported = {
        name: statistics.median(_seconds([sys.executable, "-c", f"import {name}"]) for _ in range(3))
        for name in ("torch", "onnxruntime", "sys")
    }
    for runtime in (Runtime.TORCH, Runtime.ONNXRUNTIME):
        with tempfile.TemporaryDirectory() as folder:
            data, chosen = Path(folder) / "data", {"DEEPSIMBAD_NETWORK_RUNTIME": runtime.value}
            with LocalServer(data, environment=chosen) as server, Client(server.url) as client:
                client.admin.put_domain(_DOMAIN, {"kind": "feature_l2"})
            took = []
            for _ in range(5):
                began = time.perf_counter()
                with LocalServer(data, environment=chosen):
                    took.append(time.perf_counter() - began)
        yield f"| {statistics.median(took):.2f} | {runtime.value} |"
    yield from (
        "",
        f"Of which importing torch alone takes {imported['torch'] - imported['sys']:.2f} s, ONNX Runtime "
        f"{imported['onnxruntime'] - imported['sys']:.2f} s. The very first start with ONNX Runtime prepares "
        "the network besides, some seconds, unless `deepsimbad` did so before on this machine.",
        "",
    )


def _seconds(command: list[str]) -> float:
    began = time.perf_counter()
    subprocess.run(command, check=True)  # noqa: S603 - our own interpreter
    return time.perf_counter() - began


def report() -> Iterator[str]:
    """The lines of the page."""
    bodies = pictures(24)
    yield from ("# Encoding", "", "Made by `python -m bench.encode`.", "", f"Machine: {describe()}", "")
    yield f"The default extractor, `efficientnet_lite0`; JPEGs of {len(bodies[0]) // 1000} kB."
    yield ""
    yield from by_runtime(bodies)
    yield from in_parts(bodies)
    yield from batches()
    yield from robots(bodies)
    yield from starts()


def main() -> None:
    """Measure, print, write docs/results/encode.md."""
    lines = []
    for line in report():
        print(line, flush=True)
        lines.append(line)
    (RESULTS / "encode.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
