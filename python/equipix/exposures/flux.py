"""Relative flux of each exposure, and what is known of it."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix._check import Floats, FluxModel, ReadOnly, as_array, check_count, per_exposure
from equipix.errors import InputError


@dataclass(frozen=True, eq=False)
class Flux(ReadOnly):
    """Relative flux c of each exposure.

    Attributes
    ----------
    kind : {"known", "prior", "fit", "linear"}
        Whether the values are exact, or the mean of a prior, or c is fitted: one for each exposure,
        or ln c linear in time.
    values : ndarray, shape (n,), float64
        The fluxes given; 1 where they are to be fitted.
    std : ndarray, shape (n,), float64, or None
        Relative standard deviations of a prior.
    time : ndarray, shape (n,), float64, or None
        When each exposure was taken, in seconds, where ln c is linear in time.
    """

    kind: Literal["known", "prior", "fit", "linear"]
    values: Floats
    std: Floats | None = None
    time: Floats | None = None

    @property
    def is_fitted(self) -> bool:
        """Whether c is fitted without a prior."""
        return self.kind in ("fit", "linear")

    @classmethod
    def of(
        cls,
        flux: ArrayLike | FluxModel | None,
        flux_std: ArrayLike | None,
        time: ArrayLike | None,
        count: int,
    ) -> Self:
        """Check what the caller gave, for `count` exposures."""
        if isinstance(flux, str):
            return cls._fitted(flux, flux_std, time, count)
        if time is not None:
            raise InputError(
                "'time' is given but 'flux' is not 'linear': leave it out, or give flux='linear'"
            )
        values = per_exposure("flux", flux, count, default=1)
        if flux_std is None:
            return cls("known", values)
        return cls("prior", values, std=_as_std(flux_std, count))

    @classmethod
    def _fitted(
        cls, flux: str, flux_std: ArrayLike | None, time: ArrayLike | None, count: int
    ) -> Self:
        ones = np.ones(count)
        if flux not in ("fit", "linear"):
            raise InputError(f"'flux' is {flux!r}, expected numbers, 'fit' or 'linear'")
        if flux_std is not None:
            raise InputError(
                f"'flux_std' is given, but 'flux' is {flux!r}: expected fluxes as numbers"
            )
        if (time is None) == (flux == "linear"):
            raise InputError("'time' and flux='linear' need each other: give both or neither")
        if time is None:
            return cls("fit", ones)
        times = per_exposure("time", time, count, default=0)
        if not np.isfinite(times).all() or len(set(times.tolist())) < 2:
            raise InputError(f"'time' is {times.tolist()}, expected seconds, not all the same")
        return cls("linear", ones, time=times)

    @property
    def model(self) -> tuple[str, list[float]]:
        """The kind, with standard deviations or times, as the compiled part takes it."""
        known = self.time if self.std is None else self.std
        return self.kind, [] if known is None else known.tolist()

    def free(self, values: Floats) -> Self:
        """Return fluxes to be fitted freely, starting from `values`."""
        return dataclasses.replace(self, kind="fit", values=values, std=None, time=None)

    def chosen(self, exposures: Sequence[int] | NDArray[Any]) -> Self:
        """Return the fluxes of some exposures."""
        std, time = (None if each is None else each[exposures] for each in (self.std, self.time))
        return dataclasses.replace(self, values=self.values[exposures], std=std, time=time)


def _as_std(flux_std: ArrayLike, count: int) -> Floats:
    array = as_array("flux_std", flux_std, ndim=(0, 1))
    if array.size != 1:
        check_count("flux_std", len(array), count)
    std = np.broadcast_to(array.ravel(), count).astype(np.float64)
    if not (np.isfinite(std).all() and (std > 0).all()):
        raise InputError(f"'flux_std' is {std.tolist()}, expected positive numbers")
    return std
