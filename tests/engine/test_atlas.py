"""One view on many domains, answered in parts by different processes."""

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

    def part(part_names: list[str]) -> object:
        mapped_domains, left_out = atlas.gather(part_names, is_all=False)
        answer = atlas.ask(mapped_domains, evaluator, view, 3, 5)
        return type(answer)(answer.log_evidences, answer.likeliest, left_out)

    single = whereabouts([part([*names, "unmapped"])], 3)
    shared = whereabouts([part(names[:2]), part(["unmapped", *names[2:]])], 3)
    assert list(single.probabilities) == list(shared.probabilities)
    assert np.allclose(list(single.probabilities.values()), list(shared.probabilities.values()), atol=1e-6)
    assert (single.n_others, list(single.left_out)) == (shared.n_others, list(shared.left_out)) == (4, ["unmapped"])
    assert abs(single.elsewhere_probability - shared.elsewhere_probability) < 1e-6
    for name, localization in single.likeliest.items():
        assert localization.belief.mode_m == shared.likeliest[name].belief.mode_m
