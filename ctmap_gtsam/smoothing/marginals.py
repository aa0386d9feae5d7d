"""Marginal covariances out of a Bayes tree, each clique's from its parent's alone.

GTSAM reads a variable's marginal by way of what the cliques above know of each other, and keeps that in every clique:
of a long run it is more than the tree itself. A clique says p(frontals | separator), and its separator is among its
parent's variables, so a walk from the roots down needs the parent's joint covariance and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from ctmap_gtsam.smoothing.elimination import Blocks

Array = NDArray[np.float64]

_SIZE = 6
"""numbers in every variable: poses' tangents and 6-vectors"""


@dataclass(frozen=True, eq=False)
class Joint:
    """What a clique's variables are together."""

    frontals: tuple[int, ...]
    """keys that no clique above has"""
    rows: Mapping[int, int]
    """key -> the first of its rows"""
    covariance: Array
    """of the frontals, then of the separator"""

    def of(self, keys: Sequence[int]) -> Array:
        """Covariance of some of the variables, in the order of the keys."""
        rows = np.array([self.rows[key] for key in keys], dtype=np.int64)[:, None] + np.arange(_SIZE)
        return self.covariance[np.ix_(rows.ravel(), rows.ravel())]

    def marginal(self, keys: Sequence[int]) -> Joint:
        """Of some of the variables alone."""
        return Joint((), {key: _SIZE * i for i, key in enumerate(keys)}, self.of(keys))


@dataclass
class _Branch:
    """A clique, and what hangs on it of those that are asked for."""

    clique: Any
    """gtsam.GaussianBayesTreeClique"""
    below: list[_Branch] = field(default_factory=list)
    """the largest first"""
    cliques: int = 1
    """in all of it"""


def covariances(blocks: Blocks, keys: Sequence[int]) -> dict[int, Array]:
    """Key -> marginal covariance (6, 6): gtsam.Marginals' but for rounding.

    Args:
        blocks: the linear system.
        keys: of which variables.
    """
    asked = set(keys)
    out: dict[int, Array] = {}
    messages = blocks.messages()
    later: Joint | None = None
    while messages:
        message = messages.pop()
        handed = () if message is None else tuple(message.keys())
        of_block, later = _of_block(blocks, len(messages), message, asked, handed, later)
        out.update(of_block)
    return out


def _of_block(
    blocks: Blocks, block: int, message: Any, asked: set[int], handed: tuple[int, ...], later: Joint | None
) -> tuple[dict[int, Array], Joint | None]:
    """Covariances of a block's own variables that are asked for, and what those together are that it was handed.

    Args:
        blocks: the linear system.
        block: which.
        message: what it is handed by the blocks before it.
        asked: keys.
        handed: keys of the message.
        later: what its neighbours in later blocks are together; None = there are none.
    """
    tree = _tree(blocks, block, message)
    out: dict[int, Array] = {}
    before: Joint | None = None
    for joint in joints(tree, [key for key in blocks.own[block].tolist() if key in asked or key in handed], later):
        out.update((key, joint.of([key])) for key in joint.frontals if key in asked)
        # a message is one factor, so one clique has all of its variables
        if handed and before is None and joint.rows.keys() >= set(handed):
            before = joint.marginal(handed)
    if handed and before is None:  # they all go on
        assert later is not None
        before = later.marginal(handed)
    return out, before


def _tree(blocks: Blocks, block: int, message: Any) -> Any:
    """gtsam.GaussianBayesTree of a block's own variables, given those of later blocks."""
    linear = blocks.graph(block, message)
    if block < len(blocks.own) - 1:
        return linear.eliminatePartialMultifrontal(blocks.own[block].tolist())[0]
    return linear.eliminateMultifrontal(blocks.ordering(linear))


def joints(tree: Any, keys: Sequence[int], later: Joint | None = None) -> Iterator[Joint]:
    """What the cliques of a gtsam.GaussianBayesTree say that have some keys, and all above them; parents first.

    Of a clique's branches the largest is last, and then nobody needs the clique any more: of n cliques no more than
    log2(n) + 2 are held at once.

    Args:
        tree: of some variables, given others.
        keys: of the some.
        later: of the others; None = there are none.
    """
    ahead: list[tuple[_Branch, Joint | None]] = [(root, later) for root in _branches(tree, keys)]
    while ahead:
        branch, above = ahead.pop()
        joint = _joint(branch.clique.conditional(), above)
        ahead += [(child, joint) for child in branch.below]
        del branch, above
        yield joint


def _branches(tree: Any, keys: Sequence[int]) -> list[_Branch]:
    """Those of the roots. GTSAM's wrapper knows a clique's parent, and not its children."""
    met: dict[int, _Branch] = {}
    roots: list[_Branch] = []
    for key in keys:
        clique, child = tree[key], None
        while clique is not None:
            name = clique.conditional().firstFrontalKey()
            known = met.get(name)
            branch = known or met.setdefault(name, _Branch(clique))
            if child is not None:
                branch.below.append(child)
            if known is None and clique.isRoot():
                roots.append(branch)
            clique, child = (None if known or clique.isRoot() else clique.parent()), branch
    down = [*roots]
    for branch in down:
        down += branch.below
    for branch in reversed(down):
        branch.cliques += sum(child.cliques for child in branch.below)
        branch.below.sort(key=lambda child: -child.cliques)
    return roots


def _joint(conditional: Any, above: Joint | None) -> Joint:
    """p(frontals, separator), where R f + S s = d + e of unit noise e, and the parent knows s."""
    keys, R = conditional.keys(), conditional.R()
    n, own = len(R), len(R) // _SIZE
    rows = {key: _SIZE * i for i, key in enumerate(keys)}
    root = _solved(R, np.eye(n))
    if above is None or own == len(keys):
        return Joint(tuple(keys[:own]), rows, root @ root.T)
    covariance = np.empty((_SIZE * len(keys),) * 2)
    shared = covariance[n:, n:] = above.of(keys[own:])
    follows = -_solved(R, conditional.S())
    across = covariance[:n, n:] = follows @ shared
    covariance[n:, :n] = across.T
    own_part = root @ root.T + across @ follows.T
    covariance[:n, :n] = 0.5 * (own_part + own_part.T)
    return Joint(tuple(keys[:own]), rows, covariance)


def _solved(R: Array, right: Array) -> Array:
    """R^-1 right of an upper triangle."""
    out, failed = dtrtrs(R, right)
    assert failed == 0  # the elimination would have told before
    return np.asarray(out)
