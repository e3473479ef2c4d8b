"""NetVLAD (Arandjelovic et al. 2016): VGG16, soft assignment to words, whitening.

The weights are its authors' VGG16-NetVLAD-Pitts30K, exported from MatConvNet as a MATLAB file of plain
arrays, which hloc uses as well.
"""

from collections.abc import Mapping
from typing import Any

from snakesfm.errors import ConfigError
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch

# places of the convolutions in MatConvNet's list of layers; between the groups are poolings
GROUPS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
VLAD_LAYER, WHITENING_LAYER = 30, 33


class NetvladDescriptor:
    """NetVLAD with whitening: 4096 numbers.

    Parameters
    ----------
    state : the weights, by the names ``layers.K.weights.0`` and ``.1`` and ``mean``; sizes are theirs.
    """

    usual_side_px = 640
    multiple = 1
    # four poolings halve both sides
    smallest_side_px = 1 << (len(GROUPS) - 1)

    def __init__(self, state: Mapping[str, Any]) -> None:
        self._mean = state.get("mean")
        self._network = fill_network(_network(_sizes(state)), _renamed(state), "NetVLAD")
        self.size = int(self._network["whitening"].out_features)

    def infer(self, images: Any) -> Any:
        """See :class:`snakesfm.retrieval.descriptor.GlobalDescriptor`."""
        functional = load_torch().nn.functional
        pixels = images * 255 - self._mean.to(images.device).reshape(1, 3, 1, 1)  # type: ignore[union-attr]
        local = functional.normalize(self._network["backbone"](pixels).flatten(2), dim=1)
        shares = functional.softmax(self._network["assignment"](local), dim=1)
        # sum over places of share times (local - word), for every word
        words = self._network["words"].weight
        sums = local @ shares.transpose(1, 2) - words * shares.sum(dim=2)[:, None]
        vector = functional.normalize(functional.normalize(sums, dim=1).flatten(1), dim=1)
        return self._network["whitening"](vector)


def _sizes(state: Mapping[str, Any]) -> list[tuple[int, ...]]:
    """Shapes of the convolutions, of the words (D,K) and of the whitening (IN,OUT)."""
    places = [*(place for group in GROUPS for place in group), VLAD_LAYER, WHITENING_LAYER]
    names = [f"layers.{place}.weights.{part}" for place in places for part in (0, 1)]
    missing = [name for name in (*names, "mean") if name not in state]
    if missing:
        raise ConfigError(
            f"The weights given for NetVLAD lack {len(missing)} parameters such as '{missing[0]}': "
            "fetch the right ones."
        )
    return [tuple(state[f"layers.{place}.weights.0"].squeeze().shape) for place in places]


def _network(sizes: list[tuple[int, ...]]) -> Any:
    nn = load_torch().nn
    layers: list[Any] = []
    number = 0
    for group in GROUPS:
        if layers:
            layers.append(nn.MaxPool2d(2))
        for _ in group:
            side, _, inputs, outputs = sizes[number]
            layers += [nn.Conv2d(inputs, outputs, side, padding=side // 2), nn.ReLU()]
            number += 1
    channels, words = sizes[-2]
    # the last convolution's output is used as it is
    return nn.ModuleDict(
        {
            "backbone": nn.Sequential(*layers[:-1]),
            "assignment": nn.Conv1d(channels, words, 1, bias=False),
            "words": nn.Linear(words, channels, bias=False),
            "whitening": nn.Linear(*sizes[-1]),
        }
    )


def _renamed(state: Mapping[str, Any]) -> dict[str, Any]:
    """MatConvNet's arrays (height, width, in, out) as torch keeps them (out, in, height, width)."""
    renamed = {}
    row = 0
    for number, group in enumerate(GROUPS):
        row += number > 0
        for place in group:
            weights = state[f"layers.{place}.weights.0"]
            renamed[f"backbone.{row}.weight"] = weights.permute(3, 2, 0, 1).contiguous()
            renamed[f"backbone.{row}.bias"] = state[f"layers.{place}.weights.1"].flatten()
            row += 2
    renamed["assignment.weight"] = state[f"layers.{VLAD_LAYER}.weights.0"].T[..., None].contiguous()
    # MatConvNet adds what is subtracted here
    renamed["words.weight"] = -state[f"layers.{VLAD_LAYER}.weights.1"]
    whitening = state[f"layers.{WHITENING_LAYER}.weights.0"].squeeze()
    renamed["whitening.weight"] = whitening.T.contiguous()
    renamed["whitening.bias"] = state[f"layers.{WHITENING_LAYER}.weights.1"].flatten()
    return renamed
