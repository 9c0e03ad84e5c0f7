"""Pictures of trees, one per species, that leaf, colour, shed and carry snow with the season."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.noise import stream
from deepsimbad_client.campus.season import Season

N_SPECIES = 14
FIRST_CONIFER = 11
BUSH = N_SPECIES
"""Number of the bush among the sprites."""

WIDTH, HEIGHT = 320, 400
LEAVES = 3000

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Sprite:
    """A cut-out picture; its foot is the middle of its lower edge.

    Attributes:
        levels: BGRA pictures with colours already multiplied by their opacity, largest first, each half as large.
        solidity: Share of the crown that is opaque, for its shadow.
    """

    levels: tuple[Image, ...]
    solidity: float


def draw_trees(season: Season, seed: int) -> tuple[Sprite, ...]:
    """Draw every species, and a bush, as it looks in a season; branches stay where they are from season to season."""
    return tuple(_draw(species, season, seed) for species in range(N_SPECIES + 1))


def _draw(species: int, season: Season, seed: int) -> Sprite:
    rng = stream(seed, "tree", species)
    colour = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    if species == BUSH:
        _bush(colour, alpha, rng, season)
    elif species >= FIRST_CONIFER:
        _conifer(colour, alpha, rng, season)
    else:
        _broadleaf(colour, alpha, rng, season)
    alpha = np.asarray(cv2.GaussianBlur(alpha, (3, 3), 0.7), np.uint8)
    level = np.dstack([(colour * (alpha[:, :, None] / 255.0)).astype(np.uint8), alpha])
    levels = [np.ascontiguousarray(level)]
    while min(levels[-1].shape[:2]) > 12:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return Sprite(tuple(levels), float((alpha[: HEIGHT * 3 // 4] > 128).mean()))


def _broadleaf(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    bark = rng.uniform(0.7, 1.2) * np.array([62.0, 74, 86])
    branches = _branches(rng)
    for x0, y0, x1, y1, width, depth in branches:
        start, end, thick = (int(x0), int(y0)), (int(x1), int(y1)), max(1, round(width))
        shade = tuple(int(v * (0.8 + 0.08 * depth)) for v in bark)
        cv2.line(colour, start, end, shade, thick, cv2.LINE_AA)
        cv2.line(alpha, start, end, 255, thick, cv2.LINE_AA)
        if season.snow > 0.3 and depth < 5 and abs(x1 - x0) > 0.35 * abs(y1 - y0):
            rise = thick // 2
            lifted = (start[0], start[1] - rise), (end[0], end[1] - rise)
            cv2.line(colour, *lifted, (225, 225, 225), 1, cv2.LINE_AA)
    tips = np.array([(x1, y1) for _, _, x1, y1, _, depth in branches if depth < 3])
    # Drawn whatever the season, so that the numbers after it are the same in every season.
    which = rng.integers(0, len(tips), LEAVES)
    places = tips[which] + rng.normal(0, 9, (LEAVES, 2))
    size, tone, pick = rng.uniform(1.6, 4.8, LEAVES), rng.uniform(0.68, 1.25, LEAVES), rng.random(LEAVES)
    kept = int(LEAVES * min(1.0, season.leaf_share * rng.uniform(0.75, 1.25)))
    palette, favourite = season.leaves, rng.random()
    for k in np.argsort(places[:kept, 1])[::-1]:  # upper leaves lie over lower ones
        x, y = places[k, 0], min(places[k, 1], HEIGHT * 0.8)
        own = palette[int((favourite + 0.35 * pick[k]) * len(palette)) % len(palette)]
        lit = tone[k] * (1.22 - 0.6 * y / HEIGHT)
        radius = max(1, round(size[k] * (0.6 + 0.4 * season.leaf_share)))
        centre = (int(x), int(y))
        cv2.circle(colour, centre, radius, tuple(int(min(255, v * lit)) for v in own), -1, cv2.LINE_AA)
        cv2.circle(alpha, centre, radius, 255, -1, cv2.LINE_AA)


def _branches(rng: np.random.Generator) -> list[tuple[float, float, float, float, float, int]]:
    """From and to in pixels, width and what still grows from it: 6 is the trunk, 0 a twig."""
    spread, slender = rng.uniform(0.3, 0.62), rng.uniform(0.70, 0.80)
    grown: list[tuple[float, float, float, float, float, int]] = []

    def grow(x: float, y: float, angle: float, length: float, width: float, depth: int) -> None:
        x1, y1 = x + length * np.sin(angle), y + length * np.cos(angle)
        grown.append((x, y, x1, y1, width, depth))
        for side in (-1, 1, 0)[: 2 + int(rng.random() < 0.45)] if depth else ():
            turn = side * spread + rng.normal(0, 0.13)
            grow(x1, y1, angle * 0.9 + turn, length * slender * rng.uniform(0.85, 1.1), width * 0.66, depth - 1)

    grow(0.0, 0.0, rng.normal(0, 0.04), 1.0, 13 * rng.uniform(0.7, 1.1), 6)
    tips = np.array([branch[2:4] for branch in grown])
    margin = 18
    grow_x = (WIDTH / 2 - margin) / max(np.abs(tips[:, 0]).max(), 1e-6)
    grow_y = (HEIGHT - margin) / tips[:, 1].max()
    grow_x = min(grow_x, grow_y)
    middle, base = WIDTH / 2, HEIGHT - 1
    return [
        (middle + x0 * grow_x, base - y0 * grow_y, middle + x1 * grow_x, base - y1 * grow_y, width, depth)
        for x0, y0, x1, y1, width, depth in grown
    ]


def _conifer(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    middle, base = WIDTH // 2, HEIGHT - 18
    cv2.rectangle(colour, (middle - 5, base - 20), (middle + 5, HEIGHT), (50, 62, 74), -1)
    cv2.rectangle(alpha, (middle - 5, base - 20), (middle + 5, HEIGHT), 255, -1)
    reach = rng.uniform(62, 96)
    needles = np.array([52.0, 82, 52]) * rng.uniform(0.75, 1.15)
    for k in range(2600):
        down = float(np.sqrt(rng.random()))
        y = 12 + (base - 12) * down
        ragged = 0.8 + 0.2 * np.sin(down * 40)
        out = float(rng.uniform(-1, 1)) * reach * down * ragged
        tone, drop = rng.uniform(0.6, 1.3), rng.uniform(4, 9)
        white = season.snow > 0.3 and rng.random() < 0.35
        ink = (228, 228, 226) if white else tuple(int(v * tone * (1.1 - 0.3 * abs(out) / reach)) for v in needles)
        start = (int(middle + out), int(y))
        end = (int(middle + out * 1.08), int(y + drop * (0.4 if white else 1)))
        cv2.line(colour, start, end, ink, 2, cv2.LINE_AA)
        cv2.line(alpha, start, end, 255, 2 + (k % 2), cv2.LINE_AA)


def _bush(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    own = season.leaves if season.leaf_share > 0.1 else ((84.0, 104.0, 120.0),)
    spots = rng.normal(0, 1, (900, 2)) * (WIDTH * 0.16, HEIGHT * 0.2)
    for x, up in spots[np.argsort(spots[:, 1])]:
        place = (int(np.clip(WIDTH / 2 + x, 10, WIDTH - 10)), int(np.clip(HEIGHT * 0.55 - up, 10, HEIGHT - 6)))
        tone = rng.uniform(0.6, 1.2) * (1.2 - 0.5 * place[1] / HEIGHT)
        snowy = season.snow > 0.3 and place[1] < HEIGHT * 0.42
        leaf = own[int(rng.integers(0, len(own)))]
        ink = (226, 226, 226) if snowy else tuple(int(min(255, v * tone)) for v in leaf)
        radius = int(rng.integers(5, 12))
        cv2.circle(colour, place, radius, ink, -1, cv2.LINE_AA)
        cv2.circle(alpha, place, radius, 255, -1, cv2.LINE_AA)
