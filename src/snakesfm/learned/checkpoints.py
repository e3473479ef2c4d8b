"""Weight files of several makers as plain mappings from parameter to tensor."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snakesfm.digests import sha256_of
from snakesfm.errors import ConfigError
from snakesfm.learned.device import choose_device, load_torch
from snakesfm.learned.weights import WEIGHT_FILES, find_weights, read_sums

# keys under which makers put the parameters beside other things of their training
CONTAINERS = ("state_dict", "extractor", "model")


def read_checkpoint(model: str, folder: Path, command: str) -> Mapping[str, Any]:
    """Read the weights of a model, and check them against their known sum.

    Parameters
    ----------
    model : key of ``WEIGHT_FILES``.
    folder : the weights folder, whose files are the known ones; or a file of the user's own choice.
    command : what fetches the weights, for the error's sentence.

    Returns
    -------
    Parameter name to tensor, on the processor. Nothing in the file is executed.

    Raises
    ------
    ConfigError : the file is missing, is not the known one, or holds no weights; or there is no torch.
    """
    path = find_weights(model, folder, command)
    expected = ""
    if not folder.is_file():
        expected = WEIGHT_FILES[model].sha256 or read_sums(folder).get(path.name, "")
    if expected and sha256_of(path) != expected:
        raise ConfigError(
            f"{path} is not the expected file for '{model}' (its SHA-256 differs): remove it and run "
            f"'{command}'."
        )
    torch = load_torch()
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        if path.suffix == ".mat":
            return _read_matlab(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
        for key in CONTAINERS:
            if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
                content = content[key]
        return {str(name): tensor for name, tensor in content.items() if torch.is_tensor(tensor)}
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ConfigError(
            f"{path} contains no weights that torch can read ({reason}): remove it and run '{command}'."
        ) from None


def _read_matlab(path: Path) -> Mapping[str, Any]:
    """Weights of MatConvNet as ``layers.K.weights.W``, and the mean colour as ``mean``, float32."""
    import numpy as np
    from scipy.io import loadmat

    torch = load_torch()
    network = loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
    state = {}
    for number, layer in enumerate(network.layers):
        for part, weights in enumerate(np.atleast_1d(getattr(layer, "weights", ()))):
            values = np.ascontiguousarray(weights, np.float32)
            state[f"layers.{number}.weights.{part}"] = torch.from_numpy(values)
    colour = np.asarray(network.meta.normalization.averageImage, np.float32).reshape(-1, 3)[0]
    return {**state, "mean": torch.from_numpy(np.ascontiguousarray(colour))}


def fill_network(
    network: Any, state: Mapping[str, Any] | None, name: str, optional: tuple[str, ...] = ()
) -> Any:
    """Put weights into a network and make it ready to infer, on the chosen device.

    Parameters
    ----------
    network : torch module.
    state : parameters by name; unknown ones are left out. None keeps the random ones, for tests.
    name : of the network, for the error's sentence.
    optional : ends of the names of parameters and buffers that need not be there.

    Raises
    ------
    ConfigError : a parameter is missing or of another shape.
    """
    if state is not None:
        own = network.state_dict()
        try:
            result = network.load_state_dict({k: v for k, v in state.items() if k in own}, strict=False)
        except RuntimeError as error:
            reason = str(error).splitlines()[-1].strip()
            raise ConfigError(
                f"The weights given for {name} belong to another network ({reason}): fetch the right ones."
            ) from None
        missing = [key for key in result.missing_keys if not key.endswith(optional or ("\0",))]
        if missing:
            raise ConfigError(
                f"The weights given for {name} lack {len(missing)} parameters such as '{missing[0]}': "
                "fetch the right ones."
            )
    return network.eval().to(choose_device())
