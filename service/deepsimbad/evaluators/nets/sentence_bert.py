"""Sentence embeddings by BERT (Devlin et al. 2018; Reimers, Gurevych 2019), as sentence-transformers' folders hold it.

Read are `config.json`, `tokenizer.json`, `model.safetensors` and, where there, `1_Pooling/config.json`: nothing in them
is run. The embedding is the mean of the last layer over all pieces of a text, at unit length.
"""

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingPackageError

INSTALL = "pip install 'deep-simbad[language]'"
_CLAUSES_KEPT = 4096  # people say the same again; 6 MB
_MOST_PIECES = 256  # at once; a longer text is read part by part, and the parts' pieces count alike


class SentenceBert:
    """The model of a folder, loaded; raises MissingPackageError, InvalidWeightsError."""

    def __init__(self, folder: Path) -> None:
        try:
            from safetensors.torch import load_file
            from tokenizers import Tokenizer
        except ImportError as error:
            raise missing_package(error) from error
        try:
            self._config = _read_json(folder / "config.json")
            pooling = folder / "1_Pooling" / "config.json"
            by_mean = not pooling.exists() or _read_json(pooling)["pooling_mode_mean_tokens"]
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
        """[d] the embedding of a text, of unit length."""
        import torch

        first, *pieces, last = self._tokenizer.encode(text).ids
        room = min(_MOST_PIECES, int(self._config["max_position_embeddings"])) - 2
        parts = [pieces[start : start + room] for start in range(0, max(1, len(pieces)), room)]
        with torch.inference_mode():
            states = torch.cat([self._states(torch.tensor([first, *part, last])) for part in parts])
            mean = torch.nn.functional.normalize(states.mean(dim=0), dim=0)
        return np.asarray(mean.numpy(), np.float32)

    def _states(self, ids: Any) -> Any:
        """[n, d] states of the last layer, of [n] pieces' ids."""
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
            attention = scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1).reshape(n, -1)
            x = self._norm(
                x + self._linear(attention, f"{layer}attention.output.dense"), f"{layer}attention.output.LayerNorm"
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


def _read_json(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding="utf-8")))


def missing_package(error: ImportError) -> MissingPackageError:
    """The error to raise where a package of language cannot be imported."""
    return MissingPackageError(f"a package that language needs cannot be imported: {error}: {INSTALL}")
