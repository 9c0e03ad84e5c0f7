"""Episodes on a recorded drive: which frames are seen, what is passed on, what counts."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from deepsimbad.core.planners import Plan
from deepsimbad.core.route import Route
from deepsimbad.jobs.experiments.nbv import EpisodeRunner, clairvoyant_chooser, follow_plan, random_chooser
from deepsimbad.jobs.experiments.nbv import TestDrive as Drive


@dataclass
class Notebook:
    """Stands for the localizer: records its calls, and has the belief that `believe` gives for a view."""

    believe: object = None
    apart_m: float = 1.0  # its five map images: within 5 m of each other, so that it is sure from the first view on
    calls: list = field(default_factory=list)

    def start(self):
        return SimpleNamespace(n_observations=0, views=())

    def step(self, state, query, action_m=0.0, action_std_m=None):
        self.calls.append((state.n_observations, query, action_m, action_std_m))
        views = (*state.views, query)
        mass = np.ones(5) / 5 if self.believe is None else self.believe(views)
        route = Route(self.apart_m * np.arange(5))
        belief = SimpleNamespace(mass=mass, route=route, doubt=SimpleNamespace(off_route=0.0))
        new_state = SimpleNamespace(n_observations=state.n_observations + 1, views=views, belief=belief)
        return SimpleNamespace(state=new_state, plan=Plan("p", 1.0 + len(views)))


class Frames:
    """The described frames; the view of a frame is its number."""

    def at(self, frame):
        return frame


@pytest.fixture
def drive():
    """Frames at irregular places."""
    position_m = np.array([0.0, 0.9, 2.2, 3.0, 4.1, 5.0, 5.6, 7.0, 8.0, 9.1, 10.0])
    return Drive(Frames(), Route(position_m), np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4]))


# --- starts --------------------------------------------------------------------------------------------------------


def test_starts_are_uniform_over_the_frames_from_which_the_longest_episode_fits(drive):
    starts = drive.starts(5.0, 6000, seed=0)
    counts = np.bincount(starts, minlength=11)
    assert counts[:6].min() > 850, "0 to 5.0 m, from which 5 m still fit"
    assert counts[6:].sum() == 0
    again, other = (drive.starts(5.0, 6000, seed=seed) for seed in (0, 1))
    assert starts.tolist() == again.tolist() != other.tolist()
    assert drive.starts(10.1, 10, seed=0).size == 0
    assert set(drive.starts(10.0, 10, seed=0).tolist()) == {0}


# --- one episode ---------------------------------------------------------------------------------------------------


def test_the_robot_moves_exactly_so_far_and_looks_from_the_nearest_frame(drive):
    notebook = Notebook()
    episode = EpisodeRunner(notebook, drive, 3, action_std_m=0.7).run(0, 1, lambda *_: 2.5)
    # 0.9, 3.4, 5.9, 8.4 m: what is walked adds up, whatever frame was nearest
    assert notebook.calls == [(0, 1, 0.0, None), (1, 3, 2.5, 0.7), (2, 6, 2.5, 0.7), (3, 8, 2.5, 0.7)]
    assert episode.travelled_m.tolist() == [2.5, 5.0, 7.5]


def test_views_after_moves_count_and_the_first_does_not(drive):
    masses = {0: [9, 0, 0, 0, 0], 3: [1, 7, 3, 2, 2], 5: [4, 4, 4, 4, 1], 8: [0, 3, 3, 1, 1]}
    moves_m = iter([3.0, 2.0, 3.0])
    runner = EpisodeRunner(Notebook(lambda views: np.array(masses[views[-1]], float)), drive, 3)
    episode = runner.run(0, 0, lambda *_: next(moves_m, 1.0))
    # frame 3 is image 1, the best; frame 5 is image 2, tied with three others; frame 8 is image 4, behind two, tied
    assert episode.rank_share.tolist() == [0, 1.5 / 5, 2.5 / 5]
    assert episode.travelled_m.tolist() == [3, 5, 8]


def test_following_the_plan_does_what_the_last_step_recommends(drive):
    episode = EpisodeRunner(Notebook(), drive, 2).run(0, 0, follow_plan)
    assert episode.travelled_m.tolist() == [2, 5], "2 m after one view, 3 m after two"
    with pytest.raises(ValueError, match="recommends nothing"):
        follow_plan(0, SimpleNamespace(plan=None), 0.0)


# --- those who choose ----------------------------------------------------------------------------------------------


def test_random_moves_depend_on_seed_episode_and_step_alone():
    chooser = random_chooser(np.arange(1.0, 11.0), seed=3)

    def moves(chooser, episode):
        return [chooser(episode, SimpleNamespace(state=SimpleNamespace(n_observations=n)), 0.0) for n in range(1, 11)]

    assert moves(chooser, 0) == moves(random_chooser(np.arange(1.0, 11.0), seed=3), 0)
    assert moves(chooser, 0) != moves(chooser, 1)
    assert moves(chooser, 0) != moves(random_chooser(np.arange(1.0, 11.0), seed=4), 0)
    drawn = np.array([moves(chooser, episode) for episode in range(300)])
    assert abs(np.bincount(drawn.astype(int).ravel(), minlength=11)[1:] - 300).max() < 70


def test_the_clairvoyant_takes_the_move_after_which_the_truth_ranks_best(drive):
    def believe(views):
        """Right about frame 5 and about frame 8, wrong elsewhere."""
        return np.eye(5)[{5: 2, 8: 4}.get(views[-1], 0)]

    notebook = Notebook(believe)
    runner = EpisodeRunner(notebook, drive, 2)
    chooser = clairvoyant_chooser(runner, np.array([2.0, 3.0, 5.0]))
    episode = runner.run(0, 0, chooser)
    assert episode.travelled_m.tolist() == [5, 8]
    assert episode.rank_share.tolist() == [0, 0]
    calls = [call for call in notebook.calls if call[0] == 2]
    assert len(calls) == 4, "three tries and the move itself, all from the same state"


def test_of_equally_good_moves_the_clairvoyant_takes_the_shortest(drive):
    runner = EpisodeRunner(Notebook(), drive, 1)
    chooser = clairvoyant_chooser(runner, np.array([2.0, 3.0, 5.0]))
    assert runner.run(0, 0, chooser).travelled_m.tolist() == [2]


# --- until it is sure ----------------------------------------------------------------------------------------------


def sure_after(n_views, image):
    """Believes in every image alike, and from some view on in one."""
    return lambda views: np.eye(5)[image] if len(views) >= n_views else np.full(5, 0.2)


@pytest.mark.parametrize(
    ("n_views", "image", "views", "metres", "is_wrong"),
    [(1, 0, 1, 0, False), (3, 1, 3, 2, False), (3, 4, 23, 2, True), (5, 1, 5, 4, False), (99, 0, 41, 10, False)],
    ids=["at once", "in time", "mistaken", "after the moves that are ranked", "never"],
)
def test_views_and_metres_count_until_it_is_sure(n_views, image, views, metres, is_wrong):
    """A metre a move, three of them ranked; where the drive ends before it is sure, it never was."""
    drive = Drive(Frames(), Route(np.arange(11.0)), np.array([0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]))
    notebook = Notebook(sure_after(n_views, image), apart_m=100.0)
    episode = EpisodeRunner(notebook, drive, 3).run(0, 0, lambda *_: 1.0)
    assert (episode.views, episode.metres, episode.is_wrong) == (views, metres, is_wrong)
    assert len(episode.rank_share) == 3
