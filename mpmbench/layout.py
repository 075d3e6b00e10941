"""Memory layouts of records with several attributes, all generated from one declaration of the attributes.

A declaration is a list of names. Kernels get it as a macro, ``ATTRIBUTES(_)``, from which layout.cuh makes one accessor
per attribute; the host makes a NumPy record type from the same list. The layouts differ in one number, the places of a
tile: 1 is an array of structures, all places is a structure of arrays, 32 lies between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

TILE = 32  # places of an AoSoA tile: the lanes of a warp
LAYOUTS = ("soa", "aos", "aosoa")


@dataclass(frozen=True)
class Declaration:
    """Attributes that all have the same type.

    names: in memory order.  number: type of a component.  components: 1 or 4 per attribute.
    """

    names: Sequence[str]
    number: np.dtype
    components: int

    @property
    def attribute_bytes(self) -> int:
        return self.number.itemsize * self.components

    def constants(self, layout: str) -> dict[str, object]:
        """What layout.cuh is given: the declaration and the places of a tile (0 for all)."""
        double = self.number == np.float64
        kind = "real4" if self.components == 4 else "real"
        return {
            "REAL": "double" if double else "float",
            "REAL_IS_DOUBLE": double,
            "ATTRIBUTES(_)": " ".join(f"_({kind}, {name})" for name in self.names),
            "TILE": {"soa": 0, "aos": 1, "aosoa": TILE}[layout],
        }

    def pack(self, attributes: Mapping[str, np.ndarray], layout: str) -> np.ndarray:
        """Host arrays (n, components) as one buffer of bytes in the layout, filled up to whole tiles of 32."""
        count = len(attributes[self.names[0]])
        places = capacity(count)
        width = {"soa": places, "aos": 1, "aosoa": TILE}[layout]
        record = np.dtype([(name, self.number, (width, self.components)) for name in self.names])
        tiles = np.zeros(places // width, record)
        for name in self.names:
            padded = np.zeros((places, self.components), self.number)
            padded[:count] = attributes[name]
            tiles[name] = padded.reshape(-1, width, self.components)
        return tiles.view(np.uint8).reshape(-1)


def capacity(count: int) -> int:
    """Places that a buffer has for ``count`` records: whole tiles, so that every attribute is aligned."""
    return TILE * max(1, -(-count // TILE))
