"""What a remap is asked for decides how its stages weigh."""

from dataclasses import replace

import pytest

from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import REMAP_STAGES
from deepsimbad.jobs.remap_stages import RemapSize, remap_stages

CONFIG = RemapConfig("drive", "other")
SIZE = RemapSize(12_000, 12_000, 512)


def test_the_stages_stay_the_same_and_none_weighs_nothing():
    for config in (
        CONFIG,
        replace(CONFIG, training_episodes=0),
        replace(CONFIG, relevance="brute_force"),
        RemapConfig("drive", append=True),
    ):
        for size in (SIZE, RemapSize(0, 0, 0)):
            stages = remap_stages(config, size)
            assert list(stages) == list(REMAP_STAGES)
            assert min(stages.values()) > 0


def test_training_weighs_by_its_episodes_up_to_what_a_small_map_takes():
    def trained(n_episodes, size=SIZE):
        return remap_stages(replace(CONFIG, training_episodes=n_episodes), size)["train"]

    assert trained(300_000) == pytest.approx(30 * trained(10_000), rel=0.01)
    assert trained(10_000_000) == trained(25 * 12_000)
    small = RemapSize(100, 100, 512)
    assert trained(300_000, small) == trained(2_500, small)


def test_landmarks_that_stay_cost_nothing_and_what_is_appended_is_not_trained():
    kept = remap_stages(RemapConfig("drive"), replace(SIZE, n_candidates=0))
    assert kept["select landmarks"] < 0.1 < remap_stages(CONFIG, SIZE)["select landmarks"]
    appended = remap_stages(RemapConfig("drive", append=True), replace(SIZE, n_candidates=0))
    assert appended["train"] < 0.1 < kept["train"]


@pytest.mark.parametrize("n_episodes", [0, 10_000, 300_000])
def test_the_time_left_is_right_from_describe_on_where_stages_take_what_they_weigh(n_episodes):
    config = replace(CONFIG, training_episodes=n_episodes)
    now_s, seen = [0.0], []
    stages = remap_stages(config, SIZE)
    progress = Progress(stages, seen.append, interval_s=0, clock=lambda: now_s[0])
    for stage, seconds in stages.items():
        progress.stage(stage)
        for percent in range(1, 101):
            now_s[0] += 3 * seconds / 100  # on a slower machine
            progress.update(percent / 100)
            if seen[-1].eta_s is not None:
                assert seen[-1].eta_s == pytest.approx(3 * sum(stages.values()) - now_s[0], abs=0.01)
    assert next(state.stage for state in seen if state.eta_s is not None) in list(stages)[:3]


def test_the_size_is_that_of_the_traverses(catalog, drive):
    drive("drive", 12)
    drive("other", 30)
    drive("empty", 0)
    data_dir = catalog.data_dir
    assert RemapSize.of(data_dir, "route", CONFIG) == RemapSize(12, 30, 6)
    assert RemapSize.of(data_dir, "route", RemapConfig("drive")) == RemapSize(12, 0, 6)
    assert RemapSize.of(data_dir, "route", RemapConfig("empty", "drive")) == RemapSize(0, 12, 0)
