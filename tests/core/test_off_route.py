"""Whether the robot is on the route at all: the model against planted samples, and walks on and off a made-up route."""

import math

import numpy as np
import pytest

from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.off_route import OffRouteModel, agreement_of
from deepsimbad.core.relevance import Relevance

from .conftest import a_map


def test_agreement_is_by_how_much_belief_explains_a_view_better_than_chance():
    rng = np.random.default_rng(3)
    mass, relevance = rng.dirichlet(np.ones(50)), rng.normal(size=50).astype(np.float32) * 5
    believed = sum(mass[m] * math.exp(0.3 * relevance[m]) for m in range(50))
    chance = sum(math.exp(0.3 * relevance[m]) for m in range(50)) / 50
    assert agreement_of(mass, relevance) == pytest.approx(math.log(believed / chance), rel=1e-5)


def test_agreement_of_a_belief_that_knows_nothing_is_none():
    relevance = np.random.default_rng(3).normal(size=50).astype(np.float32) * 5
    assert agreement_of(np.full(50, 0.02), relevance) == pytest.approx(0, abs=1e-6)
    assert agreement_of(np.full(50, 0.02), relevance - 1e4) == pytest.approx(0, abs=1e-3), "worse on the whole map"
    assert np.isfinite(agreement_of(np.eye(50)[0], np.array([-3e4, *([3e4] * 49)], np.float32)))


def test_the_model_is_that_of_two_planted_samples():
    """For two normal samples of equal spread s the log-odds are linear with slope (off - on) / s^2."""
    rng = np.random.default_rng(4)
    on, off = 2 + 0.7 * rng.standard_normal(40_000), 1 + 0.7 * rng.standard_normal(40_000)
    model = OffRouteModel.fit(on, off)
    assert model.slope == pytest.approx(-1 / 0.49, rel=0.03)
    assert -model.intercept / model.slope == pytest.approx(1.5, abs=0.02), "even odds halfway"


def test_probabilities_of_the_model_are_calibrated():
    rng = np.random.default_rng(5)
    on, off = rng.exponential(2.0, 50_000), rng.exponential(0.7, 50_000)  # whose log-odds are linear
    model = OffRouteModel.fit(on, off)
    evidence = np.r_[on, off]
    is_off = np.r_[np.zeros(50_000), np.ones(50_000)]
    told = 1 / (1 + np.exp(-(model.intercept + model.slope * evidence)))
    for low in (0.1, 0.3, 0.5, 0.7):
        among = (told >= low) & (told < low + 0.2)
        assert is_off[among].mean() == pytest.approx(told[among].mean(), abs=0.02)


@pytest.mark.parametrize("off", [np.zeros(30), np.full(30, 100.0)], ids=["all alike", "wholly apart"])
def test_a_model_of_degenerate_samples_is_finite(off):
    model = OffRouteModel.fit(np.zeros(30), off)
    assert np.isfinite([model.slope, model.intercept]).all()


@pytest.mark.parametrize(
    ("agreement", "log_odds"), [(-90, 3), (0, 0.5), (0.5, -0.5), (90, -3), (None, 0)], ids=lambda value: f"{value}"
)
def test_the_probability_follows_bayes_rule_and_one_view_settles_nothing_alone(agreement, log_odds):
    moved = 0.3 * 0.95 + 0.7 * 0.01
    likelihood = math.exp(log_odds)
    expected = moved * likelihood / (moved * likelihood + (1 - moved))
    assert OffRouteModel(-2.0, 0.5).after(0.3, agreement) == pytest.approx(expected)


def route_in_two_seasons(n, noise):
    rng = np.random.default_rng(7)
    place = rng.normal(size=(n, 40))
    second = place + noise * rng.normal(size=place.shape)
    places = np.stack([np.arange(n), np.arange(n)], axis=1)
    season = SecondSeason(second.astype(np.float32), places)
    return a_map(Relevance.CALIBRATED, place.astype(np.float32), 4, season), season


def test_it_learns_that_agreement_speaks_for_the_route():
    model = OffRouteModel.learn(*route_in_two_seasons(400, noise=0.5))
    assert model.slope < 0
    assert model.intercept > 0, "a belief that explains a view no better than chance is off"
    assert model.intercept + 3 * model.slope < -1


def test_where_seasons_share_too_short_a_stretch_nothing_is_learnt():
    built, season = route_in_two_seasons(400, noise=0.5)
    short = SecondSeason(season.dissimilarities, season.places[:30])
    assert OffRouteModel.learn(built, short) is None
