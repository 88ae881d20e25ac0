"""Corrections from the scene, frame by frame, on values scaled to [0, 1].

Each class holds the gain g and the offset o of the corrected frame X = g y + o, and `update` takes
a frame. The names and defaults of the numbers are those of `equipix.scene`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[Any]


def held(gain: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """Coefficients in the gauge mean gain 1, mean offset 0: (X − mean(o)) / mean(g)."""
    scale = gain.mean()
    return gain / scale, (offset - offset.mean()) / scale


def neighbours(image: Floats, kernel: ArrayLike) -> Floats:
    """Weighted mean of the neighbours, by shifts of the image, reflected about its edge pixels."""
    kernel = np.asarray(kernel, np.float64)
    rows, cols = image.shape
    reach = [size // 2 for size in kernel.shape]
    padded = np.pad(image, [(n, n) for n in reach], mode="reflect")
    total = np.zeros(image.shape)
    for (i, j), weight in np.ndenumerate(kernel / kernel.sum()):
        total += weight * padded[i : i + rows, j : j + cols]
    return total


def box(image: Floats, width: int) -> Floats:
    """Mean over a square of odd width, reflected about the edge pixels, from cumulative sums."""
    reach = width // 2
    padded = np.pad(image, reach, mode="reflect")
    sums = np.pad(padded, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    low, high = sums[:-width], sums[width:]
    means: Floats = (
        high[:, width:] - high[:, :-width] - low[:, width:] + low[:, :-width]
    ) / width**2
    return means


def steps(step: float, depth: Floats) -> Floats:
    """Step of each pixel: shorter where the raw value is more than 1 from the centre."""
    return step / np.maximum(1, (1 + depth**2) / 2)


class Descent:
    """Gain and offset that follow errors, with a step that follows their noise.

    The gain belongs to the raw value less the mean of those so far. `half` is the noise that halves
    the step: half of the mean square by which errors differ from those two updates before, less
    `moving` of the mean of their products.
    """

    CENTRE, REMEMBERED = 1000, 32

    def __init__(
        self, shape: tuple[int, int], step: float, half: float, moving: float = 0.0
    ) -> None:
        self.gain, self.offset = np.ones(shape), np.zeros(shape)
        self.step, self.half, self.moving = step, half, moving
        self.centre, self.frames = 0.0, 0
        self.noise, self.updates = 0.0, 0
        self.before: list[Floats] = []

    def follow(self, y: Floats) -> None:
        """Take the raw values of a frame for the centre."""
        self.frames += 1
        self.centre += (y.mean() - self.centre) / min(self.frames, self.CENTRE)

    def pull(self, errors: Floats, *pulls: tuple[Floats, Floats, Floats]) -> None:
        """Change the coefficients by raw values, their errors, and the part of each pixel.

        Noise takes a share of the gain of each pixel that takes part; it is given back by parts.
        """
        if len(self.before) == 2:
            before = self.before.pop(0)
            persists = self.moving * np.mean(errors * before)
            square = np.mean((errors - before) ** 2) / 2 - persists
            self.updates += 1
            self.noise += (square - self.noise) / min(self.updates, self.REMEMBERED)
        self.before.append(errors)
        step = self.step / (1 + max(self.noise, 0) / self.half**2)
        taken = np.zeros(self.gain.shape)
        for y, error, part in pulls:
            depth = y - self.centre
            change = steps(step, depth) * error
            self.gain = self.gain + change * depth
            self.offset = self.offset + change - self.centre * change * depth
            taken += steps(step, depth) * part
        if taken.any():
            lost = (1 - self.gain).sum() / (taken * self.gain).sum()
            self.gain = self.gain * (1 + lost * taken)
            self.offset = self.offset - taken * self.offset.sum() / taken.sum()
        self.gain, self.offset = held(self.gain, self.offset)


class LocalMean(Descent):
    """Towards the mean of the neighbours, in every frame."""

    KERNEL = ((0, 1, 0), (1, 0, 1), (0, 1, 0))

    def __init__(self, shape: tuple[int, int], step: float, kernel: ArrayLike = KERNEL) -> None:
        super().__init__(shape, step, half=0.1)
        self.kernel = kernel

    def update(self, y: Floats) -> None:
        """Take a frame."""
        corrected = self.gain * y + self.offset
        error = neighbours(corrected, self.kernel) - corrected
        self.follow(y)
        self.pull(error, (y, error, np.ones(y.shape)))


class Gated(Descent):
    """Towards a local mean, where that mean changed, with shorter steps where the scene varies."""

    def __init__(
        self, shape: tuple[int, int], step: float, width: int, threshold: float, texture: float
    ) -> None:
        super().__init__(shape, step, half=0.05)
        self.width, self.threshold, self.texture = width, threshold, texture
        self.seen: Floats | None = None

    def update(self, y: Floats) -> None:
        """Take a frame."""
        self.follow(y)
        corrected = self.gain * y + self.offset
        mean = box(corrected, self.width)
        variance = np.maximum(box(corrected**2, self.width) - mean**2, 0)
        scene = mean - corrected.mean()
        if self.seen is None:
            self.seen = scene
            return
        changed = np.abs(scene - self.seen) > self.threshold
        self.seen = np.where(changed, scene, self.seen)
        part = changed / (1 + self.texture * variance)
        if changed.any():
            error = part * (mean - corrected)
            self.pull(error, (y, error, part))


class Registered(Descent):
    """Towards the other frame of a pair, moved by the shift between them."""

    def __init__(
        self,
        shape: tuple[int, int],
        step: float,
        least_motion: float,
        most_motion: int,
        cutoff: float = 0.1,
        agreement: float = 0.3,
    ) -> None:
        super().__init__(shape, step, half=2 * 0.02, moving=0.5)
        self.least, self.most = least_motion, most_motion
        self.cutoff, self.agreement = cutoff, agreement
        self.usual, self.pairs = 0.0, 0
        self.earlier: tuple[Floats, Floats] | None = None
        self.spline = [np.linalg.inv(_sampling(size)) for size in shape]
        self.moves: list[tuple[float, float]] = []

    def update(self, y: Floats) -> None:
        """Take a frame."""
        self.follow(y)
        corrected = self.gain * y + self.offset
        spectrum = self.spectrum(corrected)
        if self.earlier is None:
            self.earlier = (y, spectrum)
            return
        move, agreement = self.motion(self.earlier[1], spectrum)
        self.moves.append(tuple(move))
        if np.hypot(*move) < self.least and agreement >= self.least_agreement():
            return
        if agreement >= self.least_agreement() and np.max(np.abs(move)) <= self.most:
            self.learn(self.earlier[0], y, move)
        self.earlier = (y, spectrum)

    def learn(self, first: Floats, second: Floats, move: Floats) -> None:
        """Change the coefficients by both frames of a pair."""
        error = self.error(first, second, move)
        if not self.takes(np.sum(error**2) / np.count_nonzero(error)):
            return
        back = -self.transposed(error, move)
        rows, cols = self.matrices(move)
        inside = np.outer(rows.any(1), cols.any(1)).astype(float)
        diagonal = np.outer((rows**2).sum(0), (cols**2).sum(0))
        self.pull(error + back, (second, error, inside), (first, back, diagonal))

    def takes(self, square: float) -> bool:
        """Whether a pair's mean square difference is at most four times that of earlier pairs."""
        limit = 4 * self.usual
        usual = self.pairs == 0 or square <= limit
        self.pairs += 1
        self.usual += ((square if usual else limit) - self.usual) / min(self.pairs, 16)
        return usual

    def least_agreement(self) -> float:
        """Mean cosine that unrelated frames exceed at their best shift in 1 % of the cases.

        Chernoff's bound of n / 2.88 independent phases, over the independent shifts searched.
        """
        shifts = max(np.pi * ((2 * self.most + 1) * self.cutoff) ** 2, 1)
        wanted = np.log(shifts / 0.01) * 2.88 / np.count_nonzero(self.used)
        cosines = np.cos(2 * np.pi * np.arange(1024) / 1024)
        low, high = 0.0, 1e3
        for _ in range(60):
            middle = (low + high) / 2
            weights = np.exp(middle * (cosines - 1))
            mean = np.average(cosines, weights=weights)
            rate = middle * (mean - 1) - np.log(weights.mean())
            low, high = (middle, high) if rate < wanted else (low, middle)
        return max(self.agreement, float(mean))

    def error(self, first: Floats, second: Floats, move: Floats) -> Floats:
        """Difference of a pair where the moved frame is inside, less its mean; 0 elsewhere."""
        rows, cols = self.matrices(move)
        moved = rows @ (self.gain * first + self.offset) @ cols.T
        inside = np.outer(rows.any(1), cols.any(1))
        error = np.where(inside, moved - (self.gain * second + self.offset), 0)
        error[inside] -= error[inside].mean()
        return error

    def spectrum(self, image: Floats) -> Floats:
        """Low frequencies of an image under a Hann window, one of each pair ±f, f apart."""
        windows = [np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in image.shape]
        window = np.outer(*windows)
        weighted = window * (image - image.mean())
        self.row_frequency = np.fft.fftfreq(image.shape[0])[:, None]
        self.col_frequency = np.fft.fftfreq(image.shape[1])
        radius = np.hypot(self.row_frequency, self.col_frequency)
        half = (self.col_frequency > 0) | ((self.col_frequency == 0) & (self.row_frequency > 0))
        self.used = (radius < self.cutoff) & (radius > 0) & half
        spectrum: Floats = np.fft.fft2(weighted)[self.used]
        return spectrum

    def motion(self, before: Floats, after: Floats) -> tuple[Floats, float]:
        """Shift d with after(p) = before(p + d), and the mean cosine of the phases left."""
        cross = after * before.conj()
        phase = cross / np.maximum(np.abs(cross), 1e-30)
        rows = np.broadcast_to(self.row_frequency, self.used.shape)[self.used]
        cols = np.broadcast_to(self.col_frequency, self.used.shape)[self.used]
        waves = 2 * np.pi * np.stack([rows, cols])
        whole = np.arange(-self.most, self.most + 1)
        turns = [np.exp(-1j * whole[:, None] * wave) for wave in waves]
        surface = ((turns[0] * phase) @ turns[1].T).real
        peak = np.unravel_index(np.argmax(surface), surface.shape)
        move = np.array([whole[peak[0]], whole[peak[1]]], float)
        for _ in range(8):
            left = phase * np.exp(-1j * (move @ waves))
            slope = waves @ left.imag
            curvature = -(waves * left.real) @ waves.T
            move = move - np.linalg.solve(curvature, slope)
        left = phase * np.exp(-1j * (move @ waves))
        return move, float(left.real.mean())

    def transposed(self, image: Floats, move: Floats) -> Floats:
        """Sᵀ of an image that is 0 where the moved frame is not inside."""
        rows, cols = self.matrices(move)
        return rows.T @ image @ cols

    def matrices(self, move: Floats) -> tuple[Floats, Floats]:
        """Matrices S of a move along both axes: image(p + move) by the cubic B-spline.

        Rows of pixels p for which p + move is not inside are 0.
        """
        found = []
        for spline, shift in zip(self.spline, move, strict=True):
            places = np.arange(len(spline)) + shift
            inside = (places >= 0) & (places <= len(spline) - 1)
            found.append(inside[:, None] * _along_first(spline, shift))
        return found[0], found[1]


def _sampling(size: int) -> Floats:
    """Values of a cubic B-spline at whole places, from coefficients reflected at the ends."""
    return _along_first(np.eye(size), 0.0)


def _along_first(coefficients: Floats, shift: float) -> Floats:
    """Values of a cubic B-spline at all places moved by a shift, along the first axis."""
    last = len(coefficients) - 1
    total = np.zeros(coefficients.shape)
    for step in range(-1, 3):
        whole = int(np.floor(shift)) + step
        distance = abs(shift - whole)
        near = 2 / 3 - distance**2 + distance**3 / 2
        weight = near if distance < 1 else max(2 - distance, 0) ** 3 / 6
        places = np.clip(np.arange(last + 1) + whole, -last, 2 * last)
        total += weight * coefficients[last - np.abs(last - np.abs(places))]
    return total


class Moved:
    """Whether the scene has moved since the frame that was used last."""

    BLOCK = 8

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold
        self.last: Floats | None = None
        self.noise, self.frames = 0.0, 0

    def __call__(self, y: Floats) -> bool:
        """Compare a frame by means of blocks, less their own mean, with the noise in them."""
        if self.last is not None and not self.differs(y - self.last):
            return False
        self.last = y
        self.frames += 1
        return True

    def differs(self, change: Floats) -> bool:
        """Whether the means of blocks change by more than the noise within the blocks explains."""
        rows, cols = (size // self.BLOCK for size in change.shape)
        part = change[: rows * self.BLOCK, : cols * self.BLOCK]
        blocks = part.reshape(rows, self.BLOCK, cols, self.BLOCK)
        means = blocks.mean(axis=(1, 3))
        noise = np.mean(blocks.var(axis=(1, 3)) / (self.BLOCK**2 - 1))
        variance = self.BLOCK**2 / 2 * noise
        self.noise += (variance - self.noise) / min(self.frames, 32)
        sure = 1 + 4 * np.sqrt(2 / means.size)
        return bool(means.var() > self.threshold**2 + noise * sure)


class ConstantStatistics:
    """Mean and deviation of each pixel over time made equal to those of its neighbourhood."""

    def __init__(
        self,
        shape: tuple[int, int],
        width: int,
        window: int,
        motion: float,
        prior: int,
    ) -> None:
        self.gain, self.offset = np.ones(shape), np.zeros(shape)
        self.width, self.window, self.prior = width, window, prior
        self.moved = Moved(motion)
        self.mean, self.variance = np.zeros(shape), np.zeros(shape)
        self.count = 0

    def update(self, y: Floats) -> None:
        """Take a frame."""
        if not self.moved(y):
            return
        self.count += 1
        share = 1 / min(self.count, self.window)
        deviation = y - self.mean
        self.mean = self.mean + share * deviation
        self.variance = (1 - share) * (self.variance + share * deviation**2)
        if self.count > 1:
            self.equalise()

    def equalise(self) -> None:
        """Find the coefficients that give each pixel the statistics of its neighbourhood."""
        known = min(self.count, self.window)
        share = min(self.moved.noise / self.variance.mean(), 0.9)
        noisy = share * (2 - share) / (2 * ((1 - share) * 0.05) ** 2)
        trust = known / (known + self.prior + noisy)
        deviation = np.sqrt(self.variance)
        wanted = np.maximum(box(deviation, self.width), 1e-9)
        ratio = wanted / np.maximum(deviation, 0.1 * wanted)
        gain = 1 + trust * (ratio - 1)
        offset = box(self.mean, self.width) - gain * self.mean
        self.gain, self.offset = held(gain, offset)


class Kalman:
    """Recursive Gauss-Markov estimate of each pixel's gain and offset from blocks of frames.

    y = G r + O + e with the mean r of the neighbourhood of the corrected frame. A block of n frames
    gives the normal equations of (G, O) by least squares. Their weight is 1 / V, where V is n times
    the variance of the mean of e over a block: the difference of the sums over its halves gives V.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        width: int,
        block: int,
        motion: float,
        spread: tuple[float, float],
        memory: float,
    ) -> None:
        self.gain, self.offset = np.ones(shape), np.zeros(shape)
        self.width, self.block = width, block
        self.moved = Moved(motion)
        # State: G, O about the middle of the range, their covariance.
        self.state = np.stack([np.ones(shape), np.zeros(shape)])
        self.prior = np.diag(np.square(spread))
        self.covariance = np.broadcast_to(self.prior, (*shape, 2, 2)).copy()
        self.keep = np.exp(-block / memory)
        self.clear()

    def clear(self) -> None:
        """Begin a block."""
        shape = self.gain.shape
        self.sums = np.zeros((4, *shape))
        self.first = np.zeros(shape)
        self.count = 0

    def update(self, y: Floats) -> None:
        """Take a frame."""
        if not self.moved(y):
            return
        r = box(self.gain * y + self.offset, self.width) - 0.5
        value = y - 0.5
        self.sums += [r, r**2, value, r * value]
        self.count += 1
        if self.count == self.block // 2:
            self.first = self.left()
        if self.count == self.block:
            self.learn()
            self.clear()

    def left(self) -> Floats:
        """Sum of the residuals so far in the block."""
        r, _, y, _ = self.sums
        residual: Floats = y - self.state[0] * r - self.count * self.state[1]
        return residual

    def learn(self) -> None:
        """Combine the block with the estimate before it."""
        variance = np.mean((self.left() - 2 * self.first) ** 2) / self.block
        r, rr, y, ry = self.sums
        information = np.stack(
            [np.stack([rr, r], -1), np.stack([r, np.full_like(r, self.block)], -1)], -1
        )
        mean = np.array([1.0, 0.0])[:, None, None]
        predicted = mean + self.keep * (self.state - mean)
        covariance = self.keep**2 * self.covariance + (1 - self.keep**2) * self.prior
        left = np.stack(
            [
                ry - predicted[0] * rr - predicted[1] * r,
                y - predicted[0] * r - self.block * predicted[1],
            ],
            -1,
        )
        self.covariance = np.linalg.inv(np.linalg.inv(covariance) + information / variance)
        change = np.einsum("...ij,...j->...i", self.covariance, left / variance)
        self.state = predicted + np.moveaxis(change, -1, 0)
        response = np.maximum(self.state[0], 0.1)
        self.gauge(1 / response, 0.5 - (0.5 + self.state[1]) / response)

    def gauge(self, gain: Floats, offset: Floats) -> None:
        """Hold the gauge in coefficients and state."""
        scale, shift = gain.mean(), offset.mean()
        self.gain, self.offset = held(gain, offset)
        # X = s X' + c: G' = s G, O' = O + G (c + (s − 1)/2) about the middle.
        turn = np.array([[scale, 0], [shift + (scale - 1) / 2, 1]])
        self.state = np.einsum("ij,j...->i...", turn, self.state)
        self.covariance = turn @ self.covariance @ turn.T
