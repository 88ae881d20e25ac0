"""TEMPORARY: the compiled classes of the new border on the functions of the old one."""

from types import SimpleNamespace

import numpy as np

from equipix import _native
from equipix.exposures import oldlight

_CODES = {
    "": "none",
    "as given: the fit ended before": "not tried",
    "as given: the beam tells none": "untold",
    "refined": "refined",
}


class Beam:
    def __init__(self, values, coefficients, origin):
        self.values, self.coefficients, self.origin = values, coefficients, tuple(origin)

    def light(self, shape, shift, rotation, *, workers=None):
        place = oldlight.positions(
            self.origin, np.reshape(shift, (1, 2)), np.array([rotation]), np.ones(1)
        )[0]
        return oldlight.light(self.values, place, tuple(shape))


class Exposures:
    def __init__(self, frames, shifts, **k):
        self.frames, self.given, self.k = frames, shifts, k

    def fit(self, *, start=None, **how):
        from equipix.errors import InputError

        rot, kind = np.array(self.k["rotation"]), self.k["flux_model"][0]
        rows, cols = self.frames.shape[1:]
        moves = np.ptp(self.given, axis=0).any() or (rows != cols and len(set(rot % 180)) > 1)
        fitted, sought = kind != "known" or self.k["offset"], self.k["shift_std"] is not None
        if how["method"] != "multiscale" and (fitted or sought):
            raise InputError(
                "'method' is 'coordinate-descent', which knows whole shifts and given fluxes: to "
                "fit fluxes, shifts or the dark take 'multiscale'"
            )
        if not moves and (fitted or sought or (self.given != np.rint(self.given)).any()):
            raise InputError(
                "'shifts' are all alike: each pixel sees one place of the beam, and nothing "
                "compares it with others; move the sensor between exposures"
            )
        if self.k["offset"] and kind in ("known", "prior") and len(set(self.k["flux"])) == 1:
            raise InputError(
                "'dark' is 'fit' with one flux for all: offset and gain cannot be told apart; "
                "take exposures at two or more levels and give their 'flux', or subtract a dark"
            )
        k = {n: v for n, v in self.k.items() if n not in ("workers", "progress")}
        return Fit(self, _native.calibrate_frames(self.frames, self.given, **k, **how))


class Fit:
    def __init__(self, exposures, s):
        self.exposures, self.s = exposures, s
        for name in [
            "sensitivity",
            "flags",
            "component_labels",
            "components",
            "flux",
            "offset",
            "sweeps",
            "objective",
            "error_estimate",
            "ended",
            "misfit",
            "degrees_of_freedom",
            "smallest_ritz",
            "leaves_tilt",
        ]:
            setattr(self, name, getattr(s, name))
        self.is_joint = s.coefficients is not None
        self.beam = Beam(s.beam, s.coefficients, s.beam_origin)
        self.shifts = exposures.given.tolist() if s.shifts is None else s.shifts
        self.refinement = _CODES[s.refinement]

    def information(self, *, workers=None):
        e = self.exposures
        usable = np.isfinite(e.frames)
        if e.k["mask"] is not None:
            usable &= ~e.k["mask"]
        shape = e.frames.shape[1:]
        weight = np.zeros(shape)
        places = oldlight.positions(
            self.beam.origin, np.array(self.shifts), np.array(e.k["rotation"]), np.array(self.flux)
        )
        for k, place in enumerate(places):
            seen = np.nan_to_num(oldlight.light(self.beam.values, place, shape))
            scale = 1.0 if e.k["variance"] is None else e.k["variance"][k]
            weight += usable[k] * seen**2 / scale
        return weight

    def _measurements(self):
        e, s = self.exposures, self.s
        chi2 = s.misfit / s.degrees_of_freedom if s.degrees_of_freedom > 0 else np.nan
        joint = None
        if self.is_joint:
            joint = SimpleNamespace(
                measured=e.given,
                shift_std=e.k["shift_std"],
                flux_model=e.k["flux_model"],
                offset=e.k["offset"],
                shifts=np.array(s.shifts),
                refined=self.refinement == "refined",
                coefficients=s.coefficients,
                unit=1.0 if e.k["variance"] is not None or np.isnan(chi2) else chi2,
            )
        return SimpleNamespace(
            frames=e.frames,
            shifts=np.rint(e.given).astype(np.int64),
            rotation=e.k["rotation"],
            flux=list(s.flux),
            variance=e.k["variance"],
            mask=e.k["mask"],
            joint=joint,
        )

    def uncertainty(self, *, error_map, functionals, shifts, offset, workers=None, progress=None):
        m = self._measurements()
        cells = self.s.coefficients if self.is_joint else self.s.beam
        dtype = np.float32 if self.exposures.frames.dtype == np.float32 else np.float64
        at = (
            m,
            np.ascontiguousarray(self.s.sensitivity.astype(dtype), np.float64),
            np.ascontiguousarray(cells),
        )
        how = {"workers": workers, "progress": progress}
        answer = SimpleNamespace(
            std=None,
            draws=0,
            exactness=np.nan,
            variances=None,
            shift_variances=None,
            offset_variances=None,
        )
        if error_map:
            answer.std, answer.draws, answer.exactness = _native.error_map(*at, **how)
        if shifts:
            answer.shift_variances = _native.shift_variances(*at, **how)
        if functionals is not None:
            answer.variances = _native.functional_variances(*at, functionals=functionals, **how)
        if offset:
            answer.offset_variances = _native.offset_variances(*at, **how)
        return answer
