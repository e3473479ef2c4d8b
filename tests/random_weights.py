"""Small random weights in the layouts of their makers."""

from pathlib import Path
from typing import Any

import numpy as np

CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def write_netvlad(path: Path, channels: int = 6, words: int = 4, size: int = 16, seed: int = 0) -> None:
    """A MATLAB file as NetVLAD's authors' network is published: VGG16 with few channels."""
    from scipy.io import savemat

    rng = np.random.default_rng(seed)
    layers = [{"type": "other"} for _ in range(34)]

    def fill(place: int, first: Any, second: Any) -> None:
        weights = np.empty((1, 2), object)
        weights[0, 0], weights[0, 1] = first, second
        layers[place] = {"type": "conv", "weights": weights}

    inputs = 3
    for place in CONVOLUTIONS:
        kernel = rng.normal(0, 0.3 if inputs > 3 else 0.01, (3, 3, inputs, channels))
        fill(place, kernel.astype(np.float32), rng.normal(0, 0.1, (1, channels)).astype(np.float32))
        inputs = channels
    fill(30, *(rng.normal(size=(channels, words)).astype(np.float32) for _ in range(2)))
    whitening = rng.normal(size=(1, 1, channels * words, size)).astype(np.float32)
    fill(33, whitening, rng.normal(0, 0.01, (1, size)).astype(np.float32))
    mean = np.broadcast_to(np.array([123.7, 116.8, 103.9], np.float32), (8, 8, 3))
    holder = np.empty((1, len(layers)), object)
    holder[0] = layers
    savemat(path, {"net": {"layers": holder, "meta": {"normalization": {"averageImage": mean}}}})


def megaloc_state(channels: int = 64, layers: int = 2, side: int = 5, seed: int = 0) -> dict[str, Any]:
    """Weights named as MegaLoc's authors name them, of a small network."""
    import torch

    made = torch.Generator().manual_seed(seed)

    def draw(*shape: int, scale: float = 0.1) -> Any:
        return torch.randn(*shape, generator=made) * scale

    start = "backbone.model."
    state = {
        f"{start}cls_token": draw(1, 1, channels),
        f"{start}pos_embed": draw(1, side * side + 1, channels),
        f"{start}mask_token": draw(1, channels),
        f"{start}patch_embed.proj.weight": draw(channels, 3, 14, 14),
        f"{start}patch_embed.proj.bias": draw(channels),
        f"{start}norm.weight": 1 + draw(channels),
        f"{start}norm.bias": draw(channels),
    }
    for layer in range(layers):
        block = f"{start}blocks.{layer}."
        for norm in ("norm1", "norm2"):
            state |= {f"{block}{norm}.weight": 1 + draw(channels), f"{block}{norm}.bias": draw(channels)}
        for name, outputs, inputs in (
            ("attn.qkv", 3 * channels, channels),
            ("attn.proj", channels, channels),
            ("mlp.fc1", 4 * channels, channels),
            ("mlp.fc2", channels, 4 * channels),
        ):
            state |= {f"{block}{name}.weight": draw(outputs, inputs), f"{block}{name}.bias": draw(outputs)}
        state |= {f"{block}ls{part}.gamma": 1 + draw(channels) for part in (1, 2)}
    inner, size, clusters, token, outputs = 24, 8, 4, 10, 20
    start = "aggregator.agg."
    for name, place, size_out, square in (
        ("token_features", 2, token, ()),
        ("cluster_features", 3, size, (1, 1)),
        ("score", 3, clusters, (1, 1)),
    ):
        state |= {
            f"{start}{name}.0.weight": draw(inner, channels, *square),
            f"{start}{name}.0.bias": draw(inner),
            f"{start}{name}.{place}.weight": draw(size_out, inner, *square, scale=0.5),
            f"{start}{name}.{place}.bias": draw(size_out),
        }
    state[f"{start}dust_bin"] = torch.tensor(0.7)
    state["aggregator.linear.weight"] = draw(outputs, clusters * size + token)
    state["aggregator.linear.bias"] = draw(outputs)
    return state
