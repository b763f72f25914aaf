"""How the networks of a structured model are laid out: sizes, index sets, and which weights there are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import combinations_with_replacement, pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.mechanics.structure import Friction, Place

if TYPE_CHECKING:
    from exlinn_fmi.mechanics.learned import ModelSpec

Mask = NDArray[np.bool_]

DEFAULT_FRICTION: tuple[Friction, ...] = ("viscous", "coulomb")
"""Friction where none is named: viscous and smooth units, which sum up to any force that grows with speed."""
LINEAR = {"lagrangian.output", "lagrangian.coupling", "lagrangian.offset", "dissipation.viscous"}
"""Weights of the direct path."""


class Layout:
    """Sizes and index sets of the structured networks, derived from the coordinates alone.

    Network inputs z are the topology features: sin and cos of a circle, the scaled position of a line,
    nothing of a cyclic coordinate. Each output is linear in the basis [1, z, products, tanh(Wz + b)].

    Attributes:
        positions: coordinates that are not cyclic.
        owners: for each feature z the coordinate that it comes from.
        products: two or three features that are multiplied: of different coordinates, or of a line.
        blocks: members of each diagonal block of M.
        columns: number of columns of L in each block.
        terms: the functions of q in 𝓛: ("M", i, j), ("A", i, i) and ("V", 0, 0).
        outputs: the network's outputs: ("L", i, column), ("A", i, i), ("V", 0, 0).
        rows: for each coordinate the outputs that are its row of L.
        couplings: (i, j) for each constant K_ij q_j q̇_i.
        sight: for each hidden unit the coordinates that it sees.
        friction: smooth friction units of each velocity; the last `bumps` of them are Stribeck's.
        drag: whether a velocity has quadratic friction.
    """

    def __init__(self, spec: ModelSpec) -> None:
        kinds = [c.kind for c in spec.coordinates]
        n = len(kinds)
        topologies = [c.topology for c in spec.coordinates]
        self.positions = [i for i in range(n) if topologies[i] != "cyclic"]
        self.owners = [i for i in self.positions for _ in range(2 if topologies[i] == "circle" else 1)]
        self.products = [
            product
            for degree in (2, 3)
            for product in combinations_with_replacement(range(len(self.owners)), degree)
            if all(
                self.owners[a] != self.owners[b] or topologies[self.owners[a]] == "line"
                for a, b in pairwise(product)
            )
        ]
        blocks = [[i for i in range(n) if kinds[i] == kind] for kind in ("mechanical", "electrical")]
        self.blocks = [block for block in blocks if block]
        self.columns = [len(block) + len(self.positions) for block in self.blocks]
        # One component of A can be gauged away: 𝓛 + d/dt χ(q) has the same equations of motion.
        free = [i for i in range(n) if i not in self.positions[:1]] if self.positions else []
        self.terms: list[tuple[str, int, int]] = [
            ("M", *ij) for block in self.blocks for ij in combinations_with_replacement(block, 2)
        ]
        self.terms += [("A", i, i) for i in free] + [("V", 0, 0)] * bool(self.positions)
        self.outputs: list[tuple[str, int, int]] = [
            ("L", i, c)
            for block, columns in zip(self.blocks, self.columns, strict=True)
            for i in block
            for c in range(columns)
        ]
        self.outputs += [term for term in self.terms if term[0] != "M"]
        self.rows = {
            i: slice(self.outputs.index(("L", i, 0)), self.outputs.index(("L", i, columns - 1)) + 1)
            for block, columns in zip(self.blocks, self.columns, strict=True)
            for i in block
        }
        # K_ij q_j q̇_i and K_ji q_i q̇_j differ by a gauge: write it with a q that is no charge if there is
        # one.
        order = sorted(range(n), key=lambda i: (topologies[i] == "cyclic", kinds[i] == "electrical", i))
        self.couplings = [(order[b], order[a]) for a in range(n) for b in range(a + 1, n)]
        self.hidden = spec.hidden if self.positions else 0
        self.depth = spec.depth
        self.basis = 1 + len(self.owners) + len(self.products) + self.hidden
        self.coordinates, self.structure = spec.coordinates, spec.structure
        seen = self._sights()
        self.sight = [seen[h % len(seen)] for h in range(self.hidden)]
        self.laws = [spec.structure.friction_of(i, DEFAULT_FRICTION) for i in range(n)]
        self.bumps = int(any("stribeck" in laws for laws in self.laws))
        self.drag = any("quadratic" in laws for laws in self.laws)
        self.friction = -(-spec.hidden // n) + self.bumps

    def _sights(self) -> list[frozenset[int]]:
        """Sets of coordinates that hidden units are dealt out to: as many at a time as an output may mix."""
        kinds = ("mechanical", "electrical")
        parts = [frozenset(i for i in self.positions if self.coordinates[i].kind == kind) for kind in kinds]
        sets: list[frozenset[int]] = []
        for kind, i, _ in self.outputs:
            allowed = [s for s in (frozenset(self.positions), *parts) if s and self._allows(kind, i, s)]
            sets += [s for s in allowed if not any(s < other for other in allowed)]
        return list(dict.fromkeys(sets)) or [frozenset()]

    def _allows(self, kind: str, i: int, positions: Collection[int]) -> bool:
        place: Place = {"M": "M", "L": "M", "A": "A", "V": "V"}[kind]  # type: ignore[assignment]
        return self.structure.allows(place, self.coordinates, i, positions)

    def term_mask(self, term: tuple[str, int, int], products: Sequence[tuple[int, ...]]) -> Mask:
        """Which of [1, z, products] may take part in a term or an output."""
        features = [(), *((a,) for a in range(len(self.owners))), *products]
        return np.array([self._allows(term[0], term[1], {self.owners[a] for a in f}) for f in features])

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each weight array."""
        n = sum(len(block) for block in self.blocks)
        return {
            "lagrangian.hidden.weight": (self.hidden, len(self.owners)),
            "lagrangian.hidden.bias": (self.hidden,),
            **{
                f"lagrangian.hidden_{layer}.{part}": (self.hidden,) * rank
                for layer in range(2, self.depth + 1)
                for part, rank in (("weight", 2), ("bias", 1))
            },
            "lagrangian.output": (len(self.outputs), self.basis),
            "lagrangian.coupling": (len(self.couplings),),
            "lagrangian.offset": (n,),
            "dissipation.viscous": (n,),
            "dissipation.friction": (n, self.friction),
            "dissipation.width": (n, self.friction),
            "dissipation.quadratic": (n,),
        }

    @property
    def free(self) -> dict[str, Mask]:
        """Which weights are trained: what has no effect, and what the plant has not, stays 0."""
        masks = {name: np.ones(shape, dtype=bool) for name, shape in self.shapes.items()}
        output = masks["lagrangian.output"]
        for row, term in zip(output, self.outputs, strict=True):
            row[: self.basis - self.hidden] = self.term_mask(term, self.products)
            row[self.basis - self.hidden :] = [self._allows(term[0], term[1], s) for s in self.sight]
        output[[kind != "L" for kind, _, _ in self.outputs], 0] = False  # constants in A and V
        for h, seen in enumerate(self.sight):
            masks["lagrangian.hidden.weight"][h] = [owner in seen for owner in self.owners]
            masks["lagrangian.hidden.bias"][h] = bool(seen)
        masks["lagrangian.coupling"][:] = [
            self.structure.allows("K", self.coordinates, i, [j]) for i, j in self.couplings
        ]
        smooth = self.friction - self.bumps
        for i, laws in enumerate(self.laws):
            masks["lagrangian.offset"][i] = self.structure.has_offset(i)
            masks["dissipation.viscous"][i] = "viscous" in laws
            masks["dissipation.quadratic"][i] = "quadratic" in laws
            for name in ("dissipation.friction", "dissipation.width"):
                masks[name][i, :smooth] = "coulomb" in laws
                masks[name][i, smooth:] = "stribeck" in laws
        return masks

    @property
    def direct(self) -> dict[str, Mask]:
        """Those of the free weights that need no hidden unit and are found by linear least squares first."""
        masks = self.free
        masks["lagrangian.output"][:, self.basis - self.hidden :] = False
        for name in masks.keys() - LINEAR:
            masks[name][:] = False
        return masks
