"""Picture files with the mark by which a later command knows that they may be replaced."""

import io
from pathlib import Path
from typing import Final

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from embomatrix.host.own_files import PICTURE_MARK
from embomatrix.world.whole_file import write_whole

JPEG_SUFFIX: Final = ".jpg"
JPEG_QUALITY: Final = 85


def write_picture(path: Path, picture: Image.Image) -> None:
    """Write a picture with its mark, as JPEG if the path ends with .jpg and as PNG otherwise. Raises OSError."""
    buffer = io.BytesIO()
    if path.suffix == JPEG_SUFFIX:
        picture.save(buffer, format="JPEG", optimize=True, quality=JPEG_QUALITY, comment=PICTURE_MARK)
    else:
        keyword, _, text = PICTURE_MARK.decode("ascii").partition("\0")
        info = PngInfo()
        info.add_text(keyword, text)
        picture.save(buffer, format="PNG", optimize=True, pnginfo=info)
    write_whole(path, buffer.getvalue())
