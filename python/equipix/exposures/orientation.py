"""Orientations of the axes of shifts against those of the frames."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from typing import Self

    from numpy.typing import NDArray

    from equipix._types import Floats


@dataclass(frozen=True)
class Orientation:
    """How given shifts and rotations are changed: signs first, then the order of the axes.

    Attributes
    ----------
    rows, cols : bool
        Whether the given values along rows, and along columns, change their sign.
    exchanged : bool
        Whether both values of each shift are exchanged, as for shifts given as (x, y).
    turned : bool
        Whether quarter turns go the other way, 90° for 270°.
    """

    rows: bool = False
    cols: bool = False
    exchanged: bool = False
    turned: bool = False

    @classmethod
    def every(cls, *, quarter_turns: bool) -> list[Self]:
        """Return all orientations, the one as given first."""
        ways = (False, True) if quarter_turns else (False,)
        found = [cls(*each) for each in product((False, True), (False, True), (False, True), ways)]
        return sorted(found, key=lambda each: sum(vars(each).values()))

    def shifts(self, given: Floats) -> Floats:
        """Return shifts (n, 2) so changed."""
        signs = np.where([self.rows, self.cols], -1.0, 1.0)
        changed = given * signs + 0.0  # no negative zeros
        return np.ascontiguousarray(changed[:, ::-1]) if self.exchanged else changed

    def rotation(self, given: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return rotations (n,), in degrees, so changed."""
        return -given % 360 if self.turned else given

    @property
    def words(self) -> str:
        """What is to be changed, as a request."""
        return "; then ".join(request for request, _ in self._changes()) or "change nothing"

    @property
    def changes(self) -> str:
        """The same, as what has been changed."""
        return " and ".join(change for _, change in self._changes()) or "nothing changed"

    def _changes(self) -> list[tuple[str, str]]:
        """Each change, as a request and as done."""
        signs = {
            (True, True): "of all shifts",
            (True, False): "of the shifts along rows",
            (False, True): "of the shifts along columns",
        }
        found = []
        if which := signs.get((self.rows, self.cols)):
            found.append((f"reverse the sign {which}", f"the sign {which} reversed"))
        if self.exchanged:
            request = "exchange the two values of each shift: (row, col), not (x, y)"
            found.append((request, "the two values of each shift exchanged"))
        if self.turned:
            request = "give 270 for 90 degrees of rotation, and 90 for 270"
            found.append((request, "rotations of 90 and 270 degrees exchanged"))
        return found
