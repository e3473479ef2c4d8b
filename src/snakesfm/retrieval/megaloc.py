"""MegaLoc (Berton and Masone 2025): DINOv2 by transformers, summed up by optimal transport (SALAD).

SALAD (Izquierdo and Civera 2024) assigns the patches of an image to clusters by a few rounds of Sinkhorn's
algorithm, with one more cluster for what is of no use.
"""

import math
from collections.abc import Mapping
from typing import Any

from snakesfm.errors import ConfigError
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch

PATCH_PX = 14
CHANNELS_PER_HEAD = 64
SINKHORN_ROUNDS = 3
# mean and deviation of the images that DINOv2 was trained on, 0 .. 1
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
BACKBONE = "backbone.model."
AGGREGATOR = "aggregator.agg."
# the authors' names of what transformers calls otherwise
NAMES = {
    "pos_embed": "embeddings.position_embeddings",
    "cls_token": "embeddings.cls_token",
    "mask_token": "embeddings.mask_token",
    "patch_embed.proj.": "embeddings.patch_embeddings.projection.",
    "blocks.": "encoder.layer.",
    "norm.": "layernorm.",
}
INSIDE = {
    "attn.proj.": "attention.o_proj.",
    "ls1.gamma": "layer_scale1.lambda1",
    "ls2.gamma": "layer_scale2.lambda1",
}


class MegalocDescriptor:
    """MegaLoc: 8448 numbers.

    Parameters
    ----------
    state : the weights under their authors' names; sizes are theirs.
    """

    usual_side_px = 322
    multiple = PATCH_PX
    smallest_side_px = 1

    def __init__(self, state: Mapping[str, Any]) -> None:
        needed = [f"{BACKBONE}cls_token", f"{BACKBONE}pos_embed", "aggregator.linear.weight"]
        needed += [f"{AGGREGATOR}{name}.weight" for name in ("score.0", "score.3", "cluster_features.3")]
        missing = [name for name in needed if name not in state]
        if missing:
            raise ConfigError(
                f"The weights given for MegaLoc lack {len(missing)} parameters such as '{missing[0]}': "
                "fetch the right ones."
            )
        self._backbone = fill_network(_backbone(state), renamed(state), "MegaLoc's DINOv2")
        self._aggregator = fill_network(_aggregator(state), _aggregator_state(state), "MegaLoc")
        self._spare = state[f"{AGGREGATOR}dust_bin"].float()
        self.size = int(self._aggregator["linear"].out_features)

    def infer(self, images: Any) -> Any:
        """See :class:`snakesfm.retrieval.descriptor.GlobalDescriptor`."""
        torch = load_torch()
        mean, deviation = (images.new_tensor(values).reshape(1, 3, 1, 1) for values in (MEAN, DEVIATION))
        tokens = self._backbone((images - mean) / deviation).last_hidden_state
        # (B,C,N): a convolution of one by one is the same for patches in a row
        patches = tokens[:, 1:].transpose(1, 2)
        normalize = torch.nn.functional.normalize
        scene = normalize(self._aggregator["token_features"](tokens[:, 0]), dim=-1)
        features = self._aggregator["cluster_features"](patches)
        shares = self._assign(self._aggregator["score"](patches))
        clusters = normalize(features @ shares.transpose(1, 2), dim=1).flatten(1)
        return self._aggregator["linear"](normalize(torch.cat([scene, clusters], dim=1), dim=1))

    def _assign(self, scores: Any) -> Any:
        """How much of each patch goes to each cluster, (B,K,N), from the scores (B,K,N)."""
        torch = load_torch()
        batch, clusters, patches = scores.shape
        spare = self._spare.to(scores).expand(batch, 1, patches)
        logits = torch.cat([scores, spare], dim=1)
        # every cluster takes as much as one patch gives, and the spare one the rest
        rows = torch.zeros(clusters + 1).to(scores)
        rows[-1] = math.log(max(patches - clusters, 1))
        columns = torch.zeros(patches).to(scores)
        along_rows = torch.zeros(batch, clusters + 1).to(scores)
        along_columns = torch.zeros(batch, patches).to(scores)
        for _ in range(SINKHORN_ROUNDS):
            along_rows = rows - torch.logsumexp(logits + along_columns[:, None], dim=2)
            along_columns = columns - torch.logsumexp(logits + along_rows[..., None], dim=1)
        return torch.exp(logits + along_rows[..., None] + along_columns[:, None])[:, :-1]


def _backbone(state: Mapping[str, Any]) -> Any:
    from transformers import Dinov2Config, Dinov2Model

    channels = int(state[f"{BACKBONE}cls_token"].shape[-1])
    side = math.isqrt(int(state[f"{BACKBONE}pos_embed"].shape[1]) - 1)
    start = f"{BACKBONE}blocks."
    layers = 1 + max(
        int(name.removeprefix(start).split(".")[0]) for name in state if name.startswith(start)
    )
    return Dinov2Model(
        Dinov2Config(
            hidden_size=channels,
            num_hidden_layers=layers,
            num_attention_heads=max(1, channels // CHANNELS_PER_HEAD),
            image_size=side * PATCH_PX,
            patch_size=PATCH_PX,
        )
    )


def renamed(state: Mapping[str, Any]) -> dict[str, Any]:
    """DINOv2's weights as its authors name them, under the names of transformers."""
    result = {}
    for name, tensor in state.items():
        if not name.startswith(BACKBONE):
            continue
        new = name.removeprefix(BACKBONE)
        start = next((start for start in NAMES if new.startswith(start)), "")
        new = NAMES.get(start, "") + new.removeprefix(start)
        for old, other in INSIDE.items():
            new = new.replace(f".{old}", f".{other}")
        if ".attn.qkv." in new:
            for part, letter in zip(tensor.chunk(3), "qkv", strict=True):
                result[new.replace(".attn.qkv.", f".attention.{letter}_proj.")] = part
        else:
            result[new] = tensor
    return result


def _aggregator(state: Mapping[str, Any]) -> Any:
    nn = load_torch().nn

    def perceptron(name: str, layers: tuple[int, int], convolve: bool) -> Any:
        inner, inputs = state[f"{AGGREGATOR}{name}.{layers[0]}.weight"].shape[:2]
        outputs = state[f"{AGGREGATOR}{name}.{layers[1]}.weight"].shape[0]
        if convolve:
            return nn.Sequential(nn.Conv1d(inputs, inner, 1), nn.ReLU(), nn.Conv1d(inner, outputs, 1))
        return nn.Sequential(nn.Linear(inputs, inner), nn.ReLU(), nn.Linear(inner, outputs))

    outputs, inputs = state["aggregator.linear.weight"].shape
    return nn.ModuleDict(
        {
            "token_features": perceptron("token_features", (0, 2), False),
            "cluster_features": perceptron("cluster_features", (0, 3), True),
            "score": perceptron("score", (0, 3), True),
            "linear": nn.Linear(inputs, outputs),
        }
    )


def _aggregator_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """The aggregator's weights; theirs has dropouts in between and works on images."""
    result = {}
    for name, tensor in state.items():
        if name.startswith(AGGREGATOR) and name != f"{AGGREGATOR}dust_bin":
            new = name.removeprefix(AGGREGATOR).replace(".3.", ".2.")
            result[new] = tensor[..., 0] if tensor.ndim == 4 else tensor
        elif name.startswith("aggregator.linear."):
            result[name.removeprefix("aggregator.")] = tensor
    return result
