"""What a session takes for usual: the map's statistics at first, and soon those of its own views."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments
from deepsimbad.core.descriptor import LandmarkStatistics
from deepsimbad.core.relevance import Query


def worth_of_move(action_m: float) -> float:
    """What a view counts for after a move: a robot that stands sees nothing new, one a metre on does."""
    return min(1.0, abs(action_m))


@dataclass(frozen=True)
class LiveStatistics:
    """Of whatever a robot sends; each kind of view is compared with views of its own kind alone."""

    ranks: LandmarkStatistics  # normal scores of ranked landmarks
    encodings: Moments | None = None  # [d]; None where encodings are not compared
    products: Moments | None = None  # [r] products of unit encodings with landmarks; None likewise

    def observing(self, query: Query, worth: float = 1.0) -> "LiveStatistics":
        """With one view more, which counts in its own comparison; `worth` of one that saw little new is less than 1."""
        if self.encodings is not None and query.encoding is not None:
            return replace(self, encodings=self.encodings.observing(query.encoding, worth))
        if self.products is not None and query.products is not None:
            return replace(self, products=self.products.observing(query.products, worth))
        return replace(self, ranks=self.ranks.observing(query.ranks, worth))

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """All that changes, to be restored bit for bit."""
        arrays = {}
        for name, moments in self._moments().items():
            arrays[name] = np.stack([moments.mean, moments.square])
            arrays[f"{name}_weight"] = np.array([moments.weight])
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.float64]]) -> "LiveStatistics":
        """What `to_arrays` of statistics like these gave; raises KeyError where an array is missing."""
        restored: dict[str, Any] = {}
        for name, moments in self._moments().items():
            mean, square = arrays[name]
            restored[name] = replace(moments, mean=mean, square=square, weight=arrays[f"{name}_weight"].item())
        return replace(self, **restored)

    def _moments(self) -> dict[str, Moments | LandmarkStatistics]:
        named = {"ranks": self.ranks, "encodings": self.encodings, "products": self.products}
        return {name: moments for name, moments in named.items() if moments is not None}
