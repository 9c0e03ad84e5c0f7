"""How surely a place is recognised."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.building import MapPlan, build_from_dissimilarities, compose_map
from deepsimbad.core.drive import Drive, SecondSeason
from deepsimbad.core.rehearsal import own_views, placed_rightly, worst_stretches
from deepsimbad.core.relevance import Relevance

N, D = 120, 32


def map_of_places(rng, first, stop):
    """Places [n, d] that all look different, but for those of one stretch; and the map of them."""
    places = rng.normal(size=(N, D))
    places[first:stop] = places[first]
    drive = Drive(position_m=2.0 * np.arange(N), encodings=views_of(rng, places))
    outcome = compose_map(MapPlan(Relevance.COMPOSED, 4, (1.0,)), drive, None, None, 60)
    return places, outcome.map, outcome.map_drive


def views_of(rng, places):
    return (places + 0.3 * rng.normal(size=places.shape)).astype(np.float32)


def dissimilarities_to(map_, encodings):
    """Squared distances [n, r] of unit encodings to the landmarks, by the season's own statistics."""
    z = (encodings - encodings.mean(axis=0)) / encodings.std(axis=0)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return (2 - 2 * z @ map_.landmark_model["prototypes"].T).astype(np.float32)


def test_places_that_look_alike_are_recognised_less_often():
    rng = np.random.default_rng(0)
    places, map_, drive = map_of_places(rng, 40, 80)
    season = SecondSeason(dissimilarities_to(map_, views_of(rng, places)), np.stack(2 * [np.arange(N)], 1))
    for second in (None, season):
        chance = placed_rightly(map_, own_views(map_, drive.dissimilarities), second)
        assert chance.shape == (N,)
        assert chance[45:75].max() < chance[:35].min()
        (stretch,) = worst_stretches(map_.position_m, chance)
        assert 35 <= stretch.first <= 45
        assert 75 <= stretch.last <= 85
        assert chance[stretch.worst] == chance[stretch.first : stretch.last + 1].min()
        assert np.isclose(stretch.chance, chance[stretch.first : stretch.last + 1].mean())
    assert np.array_equal(map_.coverage, placed_rightly(map_, own_views(map_, drive.dissimilarities), None)), (
        "the map knows it"
    )


@pytest.mark.parametrize("relevance", sorted(set(Relevance) - {Relevance.COMPOSED}))
@pytest.mark.parametrize("knows_a_season", [False, True])
def test_every_relevance_tells_where_it_can_be_trusted(relevance, knows_a_season):
    rng = np.random.default_rng(2)
    places = rng.normal(size=(N, D))
    places[40:80] = places[40]
    model = {"prototypes": rng.normal(size=(60, D)).astype(np.float32)}

    def drive():
        return Drive(position_m=2.0 * np.arange(N), encodings=views_of(rng, places))

    def measure(unmeasured_drive, landmarks):
        distances = np.linalg.norm(unmeasured_drive.encodings[:, np.newaxis] - landmarks["prototypes"], axis=2)
        return replace(unmeasured_drive, dissimilarities=distances.astype(np.float32))

    plan = MapPlan(relevance, 4, (1.0,), same_route=True)
    outcome = build_from_dissimilarities(plan, drive(), drive() if knows_a_season else None, model, measure)
    chance = outcome.map.coverage
    assert ((chance >= 0) & (chance <= 1)).all()
    assert chance[45:75].max() < 0.75 * chance[:35].mean()
    (stretch, *_) = worst_stretches(outcome.map.position_m, chance)
    assert 40 <= stretch.worst < 80


def test_a_season_that_is_alike_nowhere_lowers_every_chance():
    rng = np.random.default_rng(1)
    _, map_, drive = map_of_places(rng, 0, 1)
    strange_season = SecondSeason(dissimilarities_to(map_, rng.normal(size=(N, D))), np.stack(2 * [np.arange(N)], 1))
    chance, chance_with_season = (
        placed_rightly(map_, own_views(map_, drive.dissimilarities), second).mean() for second in (None, strange_season)
    )
    assert chance_with_season < 0.7 * chance


def test_no_stretch_stands_out_of_an_even_route():
    assert worst_stretches(np.arange(50.0), np.full(50, 0.4)) == []
