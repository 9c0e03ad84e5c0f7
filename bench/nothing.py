"""Made-up frames that show nothing, and real ones of another season, through maps of real drives.

    python -m bench.nothing

Maps are made of the Nordland railway in summer, frames 0..999, of the corridor's reference walk and of each half of it,
by that drive alone. 24 frames of every made-up kind are shown one after the other, 60 views a metre apart from an
unknown start: how many of them are said to tell nothing, and by how many bits the belief ever knew more than nothing.
Real frames are the other season's and the other walk's of the same numbers, one session over all. Asked for: all
made-up frames tell nothing, or at most 1 bit is known; no real frame tells nothing. **Bold** is what misses that.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from bench.measurement import ACTIONS_M, RESULTS, Command, machine, markdown, print_page
from bench.recordings import encoded, evaluator_of, real_recordings
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import DEFAULT_RELEVANCE
from deepsimbad.engine.localizer import NothingSeen, describe
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.image import is_blank

EXTRACTORS = ("efficientnet_lite0", "gradient_grid")
GRAINS_PX = (0, 1, 2, 4, 8, 16)  # standard deviations of the blur
N_FRAMES, N_VIEWS, N_LANDMARKS, SIZE = 24, 60, 300, (240, 320)
MOST_BITS = 1.0


def made_up() -> dict[str, list[Image]]:
    """Made-up frames by kind."""
    rng = np.random.default_rng(0)

    def grained(grain: float, level: float, spread: float) -> Image:
        noise = rng.standard_normal((*SIZE, 3))
        noise = cv2.GaussianBlur(noise, (0, 0), grain) if grain else noise
        return np.clip(level + spread * noise / noise.std(), 0, 255).astype(np.uint8)

    def lamp() -> Image:
        across, down = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
        middle = rng.normal((0.5 * SIZE[1], 0.4 * SIZE[0]), 0.1 * SIZE[0])
        fading = 60 * np.hypot(across - middle[0], down - middle[1]) / SIZE[0]
        return np.clip(260 - fading[..., np.newaxis] + rng.normal(0, 2, (*SIZE, 3)), 0, 255).astype(np.uint8)

    def clock(number: int, black: Image) -> Image:
        return np.asarray(cv2.putText(black, f"08:00:{number:02d}", (10, 30), 0, 1, (255, 255, 255), 2), np.uint8)

    kinds = {f"noise, grain {grain} px": [grained(grain, 128, 50) for _ in range(N_FRAMES)] for grain in GRAINS_PX}
    kinds["the dark, noise of 3 grey levels"] = [grained(0, 8, 3) for _ in range(N_FRAMES)]
    kinds["near-white glare"] = [grained(0, 250, 2) for _ in range(N_FRAMES)]
    kinds["glare that fades outward"] = [lamp() for _ in range(N_FRAMES)]
    kinds["black with a clock"] = [clock(number, np.zeros((*SIZE, 3), np.uint8)) for number in range(N_FRAMES)]
    kinds["the dark with a clock"] = [clock(number, grained(0, 4, 2)) for number in range(N_FRAMES)]
    return kinds


def informative_views(map_: Map, evaluator: Evaluator, frames: list[Image], n_views: int) -> tuple[float, float]:
    """Share of views, a metre apart, that are said to tell nothing, and the belief's greatest knowledge in bits."""
    localizer = ActiveLocalizer(map_, LocalizerConfig(planner="constant:5"))
    state, n_nothing, least_bits = localizer.start(), 0, np.inf
    cells = map_.route.cell_m / map_.route.cell_m.sum()
    for number in range(n_views):
        frame = frames[number % len(frames)]
        step = localizer.step(state, describe(map_, evaluator, NothingSeen() if is_blank(frame) else frame), 1.0)
        state, mass = step.state, step.state.belief.mass
        n_nothing += not step.is_informative
        least_bits = min(least_bits, -float((mass * np.log2(np.maximum(mass, 1e-300))).sum()))
    return n_nothing / n_views, -float((cells * np.log2(cells)).sum()) - least_bits


def _bold(text: str, is_miss: bool) -> str:
    return f"**{text}**" if is_miss else text


def _images(folder: Path, frames: range) -> list[Image]:
    files = sorted(file for file in folder.iterdir() if file.suffix in {".png", ".jpg"})
    return [np.asarray(cv2.imread(str(files[frame])), np.uint8) for frame in frames]


def lines() -> Iterator[str]:
    """The page."""
    data, kinds = real_recordings(), made_up()
    yield from ("# Views that show nothing", "", (__doc__ or "").strip().partition("\n\n")[2], "", machine())
    railway = (data / "nordland" / "summer", data / "nordland" / "winter")
    corridor = (data / "corridor" / "ref", data / "corridor" / "query")
    drives = {
        "Nordland": (*railway, range(1000)),
        "corridor": (*corridor, range(111)),
        "its first half": (*corridor, range(56)),
        "its second half": (*corridor, range(56, 111)),
    }
    for extractor in EXTRACTORS:
        evaluator = evaluator_of(extractor)
        rows: dict[str, list[str]] = {}
        for map_folder, live_folder, numbers in drives.values():
            training = encoded(f"{map_folder}#{numbers.start}:{numbers.stop}", extractor)
            plan = MapPlan(DEFAULT_RELEVANCE, 4, ACTIONS_M)
            map_ = compose_map(plan, training, None, None, min(N_LANDMARKS, training.n_frames // 2)).map
            for kind, frames in kinds.items():
                share, bits = informative_views(map_, evaluator, frames, N_VIEWS)
                rows.setdefault(kind, []).extend((f"{100 * share:.0f}", _bold(f"{bits:.1f}", bits > MOST_BITS)))
            frames = _images(live_folder, numbers)
            share, _ = informative_views(map_, evaluator, frames, len(frames))
            rows.setdefault("real, another season or walk", []).extend((_bold(f"{100 * share:.1f}", share > 0), ""))
        yield from ("", f"## `{extractor}`", "")
        head = [column for name in drives for column in (f"{name}: told nothing, %", "bits known at most")]
        yield from markdown(("frames", *head), ([kind, *row] for kind, row in rows.items()))


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "nothing.md"))
