"""The catalogue of a run on disk: models/models_info.json, the meshes, and catalogue.json with what BOP doesn't say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sequences import layout
from sequences.catalogue import Catalogue, ContinuousSymmetry, ObjectClass
from sequences.jsonfile import Node
from sequences.meshes import load_mesh
from sequences.problems import Checks

Array = NDArray[np.float64]

DEFAULT_CATEGORY = "unknown"
DEFAULT_PERSISTENCE_S = 12 * 3600.0


def read_obj_ids(root: Path) -> tuple[int, ...]:
    """The classes that models_info.json lists, ascending: the order of class_scores."""
    return tuple(sorted(map(_obj_id, _models_info(root).members())))


def read_catalogue(root: Path, checks: Checks) -> Catalogue:
    """The classes, without those that are wrong where `checks` gathers."""
    info = _models_info(root)
    about_file = root / layout.CATALOGUE
    about = Node.read(about_file, "") if about_file.is_file() else None
    described = set() if about is None else {key for key, _ in about.members()}
    missing = [key for key, _ in info.members() if key not in described]
    if missing:
        which = "is missing" if about is None else f"lists no class {', '.join(missing)}"
        checks.note(
            f"{layout.CATALOGUE} {which}: such classes are named obj_NNNNNN, of category {DEFAULT_CATEGORY}, "
            f"persistence {DEFAULT_PERSISTENCE_S / 3600:g} h, movable, and support nothing"
        )
    classes = []
    for key, node in info.members():
        with checks.part():
            classes.append(_read_class(root, (key, node), None if about is None else about.get(key)))
    return Catalogue(tuple(sorted(classes, key=lambda c: c.obj_id)))


def _models_info(root: Path) -> Node:
    file = root / layout.MODELS / layout.MODELS_INFO
    info = Node.read(file, "add the models of the classes, as BOP keeps them: models/models_info.json and PLY files")
    if not list(info.members()):
        raise info.error("lists no class", "add the models of the classes that may be in the place")
    return info


def _obj_id(member: tuple[str, Node]) -> int:
    key, node = member
    if not key.isdigit() or int(key) < 1:
        raise node.error("the key is not an obj_id", "key each model with its obj_id, a whole number from 1")
    return int(key)


def _read_class(root: Path, member: tuple[str, Node], about: Node | None) -> ObjectClass:
    obj_id, info = _obj_id(member), member[1]
    about = about or Node({}, root / layout.CATALOGUE, str(obj_id))
    name, category, persistence = about.get("name"), about.get("category"), about.get("persistence_s")
    supports, movable = about.get("supports"), about.get("movable")
    return ObjectClass(
        obj_id=obj_id,
        name=f"obj_{obj_id:06d}" if name is None else name.text(),
        category=DEFAULT_CATEGORY if category is None else category.text(),
        persistence_s=DEFAULT_PERSISTENCE_S if persistence is None else persistence.positive(),
        supports=False if supports is None else supports.flag(),
        movable=True if movable is None else movable.flag(),
        mesh=load_mesh(root / layout.MODELS / layout.mesh_name(obj_id)),
        diameter_m=info["diameter"].positive() * layout.MM,
        symmetries_discrete=_discrete_symmetries(info.get("symmetries_discrete")),
        symmetries_continuous=_continuous_symmetries(info.get("symmetries_continuous")),
    )


def _discrete_symmetries(node: Node | None) -> Array:
    motions = [] if node is None else [layout.motion(element) for element in node.elements()]
    others = [T for T in motions if np.abs(T - np.eye(4)).max() > layout.ROTATION_TOLERANCE]
    return np.stack([np.eye(4), *others])


def _continuous_symmetries(node: Node | None) -> tuple[ContinuousSymmetry, ...]:
    found = []
    for element in [] if node is None else node.elements():
        axis = layout.unit(element["axis"])
        offset = element.get("offset")
        found.append(ContinuousSymmetry(axis, np.zeros(3) if offset is None else offset.numbers(3) * layout.MM))
    return tuple(found)
