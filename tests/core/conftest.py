"""Small maps from dissimilarities."""

from dataclasses import replace

import numpy as np

from deepsimbad.core.building import build_map
from deepsimbad.core.drive import Drive


def a_drive(dissimilarities, encodings=None, position_m=None, **fields):
    """A measured drive, a frame a metre."""
    return Drive(
        position_m=np.arange(len(dissimilarities), dtype=float)
        if position_m is None
        else np.asarray(position_m, float),
        encodings=np.asarray(dissimilarities if encodings is None else encodings, np.float32),
        dissimilarities=dissimilarities,
        **fields,
    )


def a_map(relevance, dissimilarities, list_length, closed=False, actions_m=(), **drive):
    """A map of `a_drive`."""
    map_ = build_map(relevance, a_drive(dissimilarities, **drive), list_length, closed)
    return replace(map_, actions_m=np.array(actions_m))
