import importlib
import importlib.resources

import pytest

import ctmap_gtsam


@pytest.mark.parametrize("name", ctmap_gtsam.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    assert getattr(ctmap_gtsam, name).__doc__
    assert name in dir(ctmap_gtsam)


def test_an_unknown_name_is_the_usual_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ctmap_gtsam.nothing


@pytest.mark.parametrize("package", ["ctmap_gtsam", "factors", "sequences"])
def test_the_packages_carry_their_types(package: str) -> None:
    assert importlib.resources.files(package).joinpath("py.typed").is_file()
