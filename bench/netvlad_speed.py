"""How fast NetVLAD is here, beside its bare layers: the whole network, 640 x 480, in float32 and bfloat16.

    python -m bench.netvlad_speed

The weights are made up, of the published shapes: no value changes how long a product takes. *Bare* is the same network
of PyTorch's own modules in their best memory layout (`nn.Conv2d`, `nn.ReLU`, `nn.MaxPool2d`, `nn.Linear`), called
directly on an image that is already normalised; *ours* is what an extractor calls, from uint8 pixels to encodings.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.measurement import RESULTS, Command, Timing, interleaved, machine, markdown, print_page
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.nets.netvlad import STAGES, NetVlad
from deepsimbad.evaluators.runtimes import make_run

CHANNELS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
N_CLUSTERS, N_WHITENED = 64, 4096
WIDTH, HEIGHT = 640, 480
RUNTIMES = {Runtime.TORCH: torch.float32, Runtime.TORCH_BF16: torch.bfloat16}
NAMES = {Runtime.TORCH: "float32", Runtime.TORCH_BF16: "bfloat16"}


def made_up() -> NetVlad:
    """A network of the published shapes."""
    torch.manual_seed(0)
    network = NetVlad(CHANNELS, N_CLUSTERS, N_WHITENED, cluster_major=True)
    with torch.no_grad():
        network.get_buffer("mean").fill_(120.0)
        network.get_buffer("deviation").fill_(60.0)
        for parameter in (network.assignment, network.centres):
            nn.init.normal_(parameter, std=0.05)
    return network


class Bare(nn.Module):
    """The same layers and numbers, of PyTorch's own modules."""

    def __init__(self, network: NetVlad) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        convolutions = iter(network.trunk.convolutions)
        for n_convolutions in STAGES:
            for convolution in itertools.islice(convolutions, n_convolutions):
                assert isinstance(convolution, nn.Conv2d)
                plain = nn.Conv2d(convolution.in_channels, convolution.out_channels, 3, padding=1)
                plain.load_state_dict(convolution.state_dict())
                layers += [plain, nn.ReLU(inplace=True)]
            layers.append(nn.MaxPool2d(2))
        self.trunk = nn.Sequential(*layers[:-2])  # as NetVLAD cuts it
        self.assignment, self.centres, self.whitening = network.assignment, network.centres, network.whitening

    def forward(self, images: Tensor) -> Tensor:
        """Normalised [n, 3, height, width] to [n, d]."""
        features = self.trunk(images).permute(0, 2, 3, 1).flatten(1, 2).float()
        features = functional.normalize(features, dim=2)
        shares = torch.softmax(functional.linear(features, self.assignment), dim=2).transpose(1, 2)
        residuals = torch.matmul(shares, features) - shares.sum(2, keepdim=True) * self.centres
        encodings = functional.normalize(functional.normalize(residuals, dim=2).flatten(1), dim=1)
        assert self.whitening is not None
        return functional.normalize(self.whitening(encodings), dim=1)


@dataclass(frozen=True)
class Row:
    """Seconds a call of a batch."""

    runtime: Runtime
    batch: int
    extractor: Timing
    bare: Timing

    @property
    def share(self) -> float:
        """The extractor's throughput divided by the bare network's."""
        return _ratio(self.bare, self.extractor)


def _ratio(slow: Timing, fast: Timing) -> float:
    """Median ratio of calls paired in turn, since other load on the machine hits both."""
    return float(np.median([slow_s / fast_s for slow_s, fast_s in zip(slow.seconds, fast.seconds, strict=True)]))


def measure(device: Device, batch: int, repeats: int) -> Iterator[Row]:
    """Ours and bare in both number formats, all four in turn."""
    calls: list[Callable[[], object]] = []
    for runtime in RUNTIMES:
        calls += [extractor_call(runtime, device, batch), bare_call(runtime, device, batch)]
    timings = interleaved(calls, repeats, warm_up=2)
    for runtime, first in zip(RUNTIMES, range(0, len(timings), 2), strict=True):
        yield Row(runtime, batch, timings[first], timings[first + 1])


def extractor_call(runtime: Runtime, device: Device, batch: int) -> Callable[[], object]:
    run = make_run(made_up, Compute(runtime, device, largest_batch=batch), (WIDTH, HEIGHT))
    pixels = np.random.default_rng(0).integers(0, 256, (batch, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return lambda: run(pixels)


def bare_call(runtime: Runtime, device: Device, batch: int) -> Callable[[], object]:
    network = Bare(made_up()).eval().requires_grad_(False)
    dtype = RUNTIMES[runtime]
    network.trunk.to(dtype)
    network.to(device.value).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    images = torch.randn(batch, 3, HEIGHT, WIDTH, device=device.value).to(dtype)
    images = images.contiguous(memory_format=torch.channels_last)

    def call() -> object:
        with torch.inference_mode():
            encodings = network(images)
            return encodings.cpu()  # waits for CUDA, as ours does

    return call


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Markdown lines, and below them what bfloat16 brings, batch by batch, of calls paired in turn."""
    head = ("network in", "batch", "ours, a call", "bare layers, a call", "ours, images/s", "ours of bare's throughput")
    yield from markdown(
        head,
        [
            (
                NAMES[row.runtime],
                row.batch,
                row.extractor,
                row.bare,
                f"{row.batch / row.extractor.median_s:.3g}",
                f"**{row.share:.0%}**",
            )
            for row in rows
        ],
    )
    yield ""
    for single, half in zip(rows[::2], rows[1::2], strict=True):
        pairs = {
            "ours against ours": (single.extractor, half.extractor),
            "bare against bare": (single.bare, half.bare),
            "ours against bare layers in float32": (single.bare, half.extractor),
        }
        gains = "; ".join(f"{name} **{_ratio(*pair):.2f}** times" for name, pair in pairs.items())
        yield f"bfloat16 beside float32, batch {single.batch}: {gains}."
    yield ""


def report() -> Iterator[str]:
    """The lines of the page."""
    yield from ("# Speed of NetVLAD", "")
    yield (
        f"The whole network at {WIDTH} x {HEIGHT}: VGG16, {N_CLUSTERS} clusters, whitening to {N_WHITENED:,} numbers. "
        "Made by `python -m bench.netvlad_speed`, which explains what is compared; medians, and in brackets the range, "
        "of calls taken in turn. Ratios are medians over turns and hold on a shared machine; times are what it had to "
        "spare."
    )
    yield from ("", f"{machine()}, torch {torch.__version__}", "")
    yield from (f"## Processor, {torch.get_num_threads()} threads", "", *table(list(measure(Device.CPU, 1, 15))))
    if torch.cuda.is_available():
        on_cuda = [row for n_images in (1, 32) for row in measure(Device.CUDA, n_images, 30)]
        yield from (f"## {torch.cuda.get_device_name()}", "", *table(on_cuda))


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report(), RESULTS / "netvlad-speed.md"))
