import numpy as np
import pytest

from deepsimbad_client.campus.world import World
from deepsimbad_client.campus.zones import DECK


def _places(world, length_m):
    found = {}
    for section in world.sections:
        if section.stretch.start_m < length_m:
            for kind in ("trees", "posts", "bays"):
                found.setdefault(kind, []).extend(tuple(thing.place) for thing in getattr(section.scene, kind))
            for facade in section.scene.facades:
                found.setdefault("facades", []).append((*facade.left, *facade.right, facade.style))
    return found


def test_a_longer_world_begins_like_a_shorter_one():
    assert _places(World(3, 400), 400) == _places(World(3, 2500), 400)


def test_seeds_make_different_worlds():
    assert _places(World(0, 200), 200) != _places(World(1, 200), 200)


@pytest.mark.parametrize("seed", [0, 5])
def test_nothing_stands_on_the_route(seed):
    world = World(seed, 1200)
    line = world.route.between(0, 1500)
    for section in world.sections:
        scene = section.scene
        for thing in (*scene.trees, *scene.posts, *scene.bays):
            assert np.hypot(*(line - thing.place).T).min() >= 2.5
        for block in scene.blocks:
            edges = [
                block.corners[k] + t * (block.corners[(k + 1) % 4] - block.corners[k])
                for k in range(4)
                for t in np.linspace(0, 1, 40)
            ]
            nearest = min(np.hypot(*(line - point).T).min() for point in edges)
            assert nearest >= 2.8


def test_every_eight_stretches_hold_every_zone_bland_and_repeated_ones_too():
    zones = [section.zone for section in World(7, 2500).sections]
    for first in range(0, len(zones) - len(DECK), len(DECK)):
        assert sorted(zones[first : first + len(DECK)]) == sorted(DECK)


def test_twins_look_alike_and_courts_do_not():
    styles = {"twins": [], "court": []}
    for section in World(0, 1500).sections:
        if section.zone in styles:
            fronts = [facade.style for facade in section.scene.facades if facade.style.door]
            if len(fronts) > 3:
                styles[section.zone].append(len(set(fronts)) / len(fronts))
    assert styles["twins"]
    assert max(styles["twins"]) < 0.55  # a distant building or two may stand behind
    assert min(styles["court"]) == 1.0


def test_facades_are_seen_from_outside_their_building():
    for section in World(2, 300).sections:
        for n, block in enumerate(section.scene.blocks):
            centre = block.corners.mean(axis=0)
            for facade in section.scene.facades[4 * n : 4 * n + 4]:
                along = facade.right - facade.left
                outward = np.array([-along[1], along[0]])
                assert outward @ ((facade.left + facade.right) / 2 - centre) > 0
