import json
import math
import tomllib
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.config import Config, Keyframes, load_config
from ctmap_gtsam.runtime import settings
from sequences.errors import InputError
from sequences.options import option


@dataclass(frozen=True)
class Deep:
    """A section in a section.

    Of two paragraphs.
    """

    choice: Literal["near", "far"] = option("near", "one of two")
    grid: tuple[float, ...] = option((1.0, 2.0), "any number of them", low=-10.0)


@dataclass(frozen=True)
class Section:
    """Every kind of leaf."""

    flag: bool = option(True, "a truth value")
    count: int = option(3, "a whole number", low=-5, high=10**9)
    rate: float = option(0.5, "a number")
    name: str = option("a", "a text")
    pair: tuple[float, float] = option((0.0, 1.0), "two numbers", low=0.0, high=1.0)
    places: tuple[str, ...] = option((), "texts")
    path: str | None = option(None, "may be missing")
    limit: float | None = option(None, "may be missing", low=0.0)
    deep: Deep = field(default_factory=Deep)
    pairs: tuple[tuple[str, Deep], ...] = option((), "named sections")


@dataclass(frozen=True)
class Tree:
    """The root."""

    seed: int = option(0, "a number", low=0)
    section: Section = field(default_factory=Section)
    other: Deep = field(default_factory=Deep)

    def __post_init__(self) -> None:
        settings.check(self)


finite = st.floats(allow_nan=False, allow_infinity=False)
unit = st.floats(0.0, 1.0)
deeps = st.builds(
    Deep, choice=st.sampled_from(["near", "far"]), grid=st.lists(st.floats(-10, 1e300), max_size=4).map(tuple)
)
sections = st.builds(
    Section,
    flag=st.booleans(),
    count=st.integers(-5, 10**9),
    rate=finite,
    name=st.text(),
    pair=st.tuples(unit, unit),
    places=st.lists(st.text(), max_size=3).map(tuple),
    path=st.none() | st.text(),
    limit=st.none() | st.floats(0.0, 1e300),
    deep=deeps,
    pairs=st.lists(st.tuples(st.text(), deeps), max_size=2).map(tuple),
)
trees = st.builds(Tree, seed=st.integers(0, 2**130), section=sections, other=deeps)


def paths(tree: Any, prefix: str = "") -> list[str]:
    out = []
    for f in fields(tree):
        value = getattr(tree, f.name)
        out += paths(value, f"{prefix}{f.name}.") if is_dataclass(value) else [prefix + f.name]
    return out


@given(trees)
def test_toml_gives_the_same_tree_again(tree: Tree) -> None:
    assert settings.merge(Tree(), tomllib.loads(settings.to_toml(tree))) == tree


@given(trees, trees)
def test_json_gives_the_same_tree_again_whatever_it_is_merged_into(tree: Tree, other: Tree) -> None:
    assert settings.merge(other, json.loads(json.dumps(settings.to_dict(tree), allow_nan=False))) == tree


@given(trees)
def test_every_setting_can_be_assigned(tree: Tree) -> None:
    values = tomllib.loads(settings.to_toml(tree))

    def assignments(table: dict[str, Any], prefix: str) -> list[str]:
        out = []
        for name, value in table.items():
            if isinstance(value, dict):
                out += assignments(value, f"{prefix}{name}.")
            else:
                out.append(f"{prefix}{name}={tomlkit.item(value, _parent=tomlkit.array()).as_string()}")
        return out

    changes = settings.parse_assignments(assignments(values, ""))
    assert settings.merge(Tree(), changes) == tree


@pytest.mark.parametrize("path", paths(Config()))
def test_every_setting_says_what_it_is_and_rejects_another_type(path: str) -> None:
    *sections, name = path.split(".")
    owner: Any = Config()
    for section in sections:
        owner = getattr(owner, section)
    f = next(f for f in fields(owner) if f.name == name)
    assert f.metadata.get("doc"), f"{path} has no sentence"
    change: Any = {name: {"not": "a leaf"}}
    for section in reversed(sections):
        change = {section: change}
    with pytest.raises(InputError) as caught:
        settings.merge(Config(), change)
    assert caught.value.field == path
    assert caught.value.remedy


def test_the_printed_defaults_are_the_defaults() -> None:
    text = settings.to_toml(Config())
    assert settings.merge(Config(seed=7), tomllib.loads(text)) == Config()
    for path in paths(Config()):
        assert path.split(".")[-1] in text


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"section": {"count": 2.0}}, "section.count"),
        ({"section": {"count": True}}, "section.count"),
        ({"section": {"count": -6}}, "section.count"),
        ({"section": {"count": 10**9 + 1}}, "section.count"),
        ({"section": {"rate": "fast"}}, "section.rate"),
        ({"section": {"rate": math.nan}}, "section.rate"),
        ({"section": {"rate": 10**400}}, "section.rate"),
        ({"section": {"flag": 1}}, "section.flag"),
        ({"section": {"name": 1}}, "section.name"),
        ({"section": {"name": None}}, "section.name"),
        ({"section": {"pair": [0.0]}}, "section.pair"),
        ({"section": {"pair": 0.0}}, "section.pair"),
        ({"section": {"pair": [0.0, 2.0]}}, "section.pair[1]"),
        ({"section": {"limit": -1.0}}, "section.limit"),
        ({"section": {"deep": {"choice": "middle"}}}, "section.deep.choice"),
        ({"section": {"deep": {"grid": [1.0, -11.0]}}}, "section.deep.grid[1]"),
        ({"section": {"pairs": [["a", {"choice": "middle"}]]}}, "section.pairs[0][1].choice"),
        ({"section": {"pairs": [["a", {"grids": []}]]}}, "section.pairs[0][1].grids"),
        ({"section": {"pairs": [["a", 1.0]]}}, "section.pairs[0][1]"),
        ({"section": 3}, "section"),
        ({"seed": {"a": 1}}, "seed"),
    ],
)
def test_a_wrong_value_is_named_with_its_file(changes: dict[str, Any], path: str) -> None:
    with pytest.raises(InputError) as caught:
        settings.merge(Tree(), changes, "some.toml")
    assert (str(caught.value.file), caught.value.field) == ("some.toml", path)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("path", "nearest"),
    [("section.cuont", "section.count"), ("count", "section.count"), ("sectoin.rate", "section.rate")],
)
def test_an_unknown_setting_names_the_nearest(path: str, nearest: str) -> None:
    with pytest.raises(InputError, match="no such setting") as caught:
        settings.merge(Tree(), settings.parse_assignments([f"{path}=1"]))
    assert f"did you mean {nearest}?" in caught.value.remedy


def test_a_tree_built_in_python_is_checked_too() -> None:
    with pytest.raises(InputError, match="out of bounds"):
        Config(keyframes=Keyframes(every=0))
    with pytest.raises(InputError, match="not a whole number"):
        replace(Config(), seed="one")


def test_assignments_win_over_the_file_and_the_later_over_the_earlier(tmp_path: Any) -> None:
    file = tmp_path / "config.toml"
    file.write_text("seed = 1\n[keyframes]\nevery = 2\nmin_translation_m = 1\n")
    config = load_config(file, ["seed=3", "keyframes.every=4", "seed=5"])
    assert config == Config(seed=5, keyframes=Keyframes(every=4, min_translation_m=1.0))


@pytest.mark.parametrize("content", [b"seed = ", b"seed = 1\nseed = 2", b"\xff\xfe", None])
def test_a_file_that_is_no_toml_is_named(tmp_path: Any, content: bytes | None) -> None:
    file = tmp_path / "config.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_config(file)
    assert caught.value.file == file
    assert caught.value.remedy


@pytest.mark.parametrize("assignments", [["seed"], ["=1"], ["a..b=1"], ["seed=1", "seed.x=2"]])
def test_an_assignment_that_assigns_nothing_is_an_error(assignments: list[str]) -> None:
    with pytest.raises(InputError, match="--set"):
        load_config(assignments=assignments)
