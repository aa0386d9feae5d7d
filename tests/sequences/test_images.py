"""Images are read whole or refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sequences.errors import InputError
from sequences.images import encode_png, read_colour, read_depth

SIZE = (32, 24)
COUNTS = np.random.default_rng(0).integers(0, 2**16, (24, 32), dtype=np.uint16)
PNG = encode_png(COUNTS)
END = len(PNG) - 4  # the last four bytes are the checksum of an empty chunk


def test_depth_is_counts_times_scale(tmp_path):
    path = tmp_path / "depth.png"
    path.write_bytes(PNG)
    depth = read_depth(path, 1e-4, SIZE)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, (COUNTS * 1e-4).astype(np.float32))


@given(length=st.integers(0, END - 1))
def test_a_truncated_depth_image_is_refused(tmp_path_factory, length):
    path = tmp_path_factory.mktemp("images") / "000007.png"
    path.write_bytes(PNG[:length])
    with pytest.raises(InputError, match="truncated or damaged") as caught:
        read_depth(path, 1e-3, SIZE)
    assert caught.value.file == path
    assert caught.value.remedy


@given(position=st.integers(0, END - 1), bit=st.integers(0, 7))
def test_a_depth_image_with_one_wrong_bit_is_refused(tmp_path_factory, position, bit):
    data = bytearray(PNG)
    data[position] ^= 1 << bit
    path = tmp_path_factory.mktemp("images") / "000007.png"
    path.write_bytes(bytes(data))
    with pytest.raises(InputError) as caught:
        read_depth(path, 1.0, SIZE)
    assert caught.value.file == path


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_colour_is_refused(tmp_path, suffix):
    from PIL import Image

    path = tmp_path / f"000007{suffix}"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(path)
    read_colour(path, SIZE)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="truncated or damaged"):
        read_colour(path, SIZE)


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.full((24, 32), 7, dtype=np.uint8), 7),
        (np.full((24, 32, 3), 9, dtype=np.uint8), 9),
        (np.full((24, 32), 200 << 8, dtype=np.uint16), 200),
    ],
)
def test_grey_images_become_rgb(tmp_path, pixels, expected):
    path = tmp_path / "000001.png"
    path.write_bytes(encode_png(pixels))
    colour = read_colour(path, SIZE)
    assert colour.shape == (24, 32, 3)
    assert (colour == expected).all()


def test_without_an_image_colour_is_mid_grey():
    colour = read_colour(None, SIZE)
    assert colour.shape == (24, 32, 3)
    assert (colour == 128).all()
