"""Parts of an answer that different processes have asked for."""

import numpy as np

from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.atlas import Atlas, whereabouts
from deepsimbad.engine.localizer import ReadyEncoding
from deepsimbad.engine.maps import Maps
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog

from .conftest import DIM, add_domain, add_map, map_contents


def test_two_processes_that_share_domains_out_answer_as_one_that_has_all(catalog: Catalog) -> None:
    names = [f"d{n}" for n in range(7)]
    for number, name in enumerate(names):
        add_domain(catalog, name)
        add_map(catalog, name, map_contents(name, number + 1, Relevance.COMPOSED))
    add_domain(catalog, "unmapped")
    maps = Maps(catalog)
    atlas, evaluator = Atlas(maps), FeatureL2("none")
    view = ReadyEncoding(np.random.default_rng(3).normal(size=DIM))

    def part(some: list[str]) -> object:
        there, left_out = atlas.gather(some, is_all=False)
        asked = atlas.ask(there, evaluator, view, 3, 5)
        return type(asked)(asked.log_evidences, asked.likeliest, left_out)

    whole = whereabouts([part([*names, "unmapped"])], 3)
    shared = whereabouts([part(names[:2]), part(["unmapped", *names[2:]])], 3)
    assert list(whole.probabilities) == list(shared.probabilities)
    assert np.allclose(list(whole.probabilities.values()), list(shared.probabilities.values()), atol=1e-6)
    assert (whole.n_others, list(whole.left_out)) == (shared.n_others, list(shared.left_out)) == (4, ["unmapped"])
    assert abs(whole.elsewhere_probability - shared.elsewhere_probability) < 1e-6
    for name, localization in whole.likeliest.items():
        assert localization.belief.mode_m == shared.likeliest[name].belief.mode_m
