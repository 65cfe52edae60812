"""PNG files with the mark by which a later command knows that they may be replaced."""

import io
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from embomatrix.host.own_files import PICTURE_MARK
from embomatrix.world.whole_file import write_whole


def write_png(path: Path, picture: Image.Image) -> None:
    """Write a picture with its mark. Raises OSError."""
    keyword, _, text = PICTURE_MARK.decode("ascii").partition("\0")
    info = PngInfo()
    info.add_text(keyword, text)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True, pnginfo=info)
    write_whole(path, buffer.getvalue())
