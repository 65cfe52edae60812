"""Files of tensors, as ``torch.save`` writes them."""

from pathlib import Path
from typing import Any

import torch

from embomatrix.trainer.config.errors import reason_of


def read_tensors(path: Path, *, device: str = "cpu") -> dict[str, Any]:
    """Read a file of tensors and plain values. Raises OSError, or ValueError for a damaged file."""
    try:
        found = torch.load(path, map_location=device, weights_only=True)
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{path.name} is no file of tensors: {reason_of(error)}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path.name} holds {type(found).__name__}: expected tensors by name")
    return found
