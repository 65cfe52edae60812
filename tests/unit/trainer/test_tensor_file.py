"""Files of tensors are read back, and damaged ones raise one kind of error."""

import io

import pytest
import torch

from embomatrix.trainer.policy.tensor_file import read_tensors


def saved(value):
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


TENSORS = {"a": torch.arange(6).reshape(2, 3), "step": 3}


def test_tensors_are_read_back(tmp_path):
    path = tmp_path / "training.pt"
    path.write_bytes(saved(TENSORS))
    found = read_tensors(path)
    assert torch.equal(found["a"], TENSORS["a"])
    assert found["step"] == 3


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"Mv",
        b"PK\x03\x04",
        saved(TENSORS)[:-300],
        saved(TENSORS)[:400],
        saved([1, 2]),
        b"\x80\x02]q\x00.",
    ],
)
def test_damaged_file_raises_a_value_error_with_its_name(tmp_path, data):
    path = tmp_path / "training.pt"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"training\.pt"):
        read_tensors(path)


def test_missing_file_stays_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_tensors(tmp_path / "none.pt")
