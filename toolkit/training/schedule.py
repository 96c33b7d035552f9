"""When a fit goes to a finer lattice, how its step sizes fall, and when it is done: shares of the budget, and a validation split.

Validation views are training views that are kept aside for most of the fit; held-out views are never looked at. Once nothing is left to
decide the validation views are fitted like all others, so that no image is wasted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from dataclasses import field as default

import numpy as np

from fieldfuse.config import FitSettings
from fieldfuse.training.losses import FINE, Rates, Trust
from fieldfuse.training.start import COARSEST, FINER

RUNGS = (0.1, 0.3, 0.6, 0.8, 0.9)  # share of the budget at which each level ends at the latest, from the first one on …
PARTLY = (0.2, 0.45, 0.7, 0.85, 0.9)  # … of a fit that begins with what is known of depth, of a part: the rest takes longer
GUESSED = (0.01, 0.04, 0.12, 0.35, 0.9)  # … of one that begins with a guess, on the coarsest lattice: a hundred steps there make it smooth
# … of one that no validation views steer, at the latest: nothing shows there when a coarse level gains no more.
UNTOLD = (0.03, 0.12, 0.3, 0.55, 0.9)
LEVEL_STEPS = 100  # a level is not left, nor pruned, before so many: what has not had time to grow is not empty
PRUNE_EVERY = 150  # steps
LAST_PRUNE = 0.8  # of the budget; from here on the field is only polished, on all views
LAST_SOFT = 0.6  # of the budget; from here on colours are as they are, whatever the level
MOST_SOFT = 8.0  # pixels
SLOWING = 1e7  # rays after which step sizes begin to fall
LAST_RATE = 0.08  # of the step sizes, at the very end
FIRST_BATCH = 256  # rays a step at the coarsest lattice, and as many times more as one is finer: early on the number of steps counts
WIDER = 4  # times as many of them on CUDA, where a step of few takes as long; with sixteen times as many fits are worse
WORTH = 0.5  # rays that must be left for every voxel of a finer level: with fewer it ends blurred, and worse than the coarser one
FINE_WORTH = 3.0  # as `WORTH`, of a level of `FINER` voxels a side or more, which also …
FINE_MOST = 6_000_000  # … has no more voxels: memory, files and exports grow with them, and what is seen hardly does
LOOK_STEPS = 60  # from one look at the validation views to the next …
FINEST_LOOK_STEPS = 250  # … and at the finest level
WINDOW = 4  # looks that a plateau is judged by
GAIN = 0.04  # decibels over a window that still count as progress at the finest level …
COARSE_GAIN = 0.1  # … and before it, where the next level gains more in the same time
LEAST_RAYS = 5e6  # of a fit that ends after so many passes over its pixels
DROPS = 2  # halvings of the step sizes on plateaus of the finest level, before the end


def most_rays(pixels: int, validated: bool, passes: float | None) -> float:
    """Rays after which a fit to so many pixels ends; ∞ where validation views show how it goes, or `passes` is None.

    With few views nothing shows it, and what comes later is learned by heart.
    """
    return math.inf if validated or passes is None else max(LEAST_RAYS, passes * pixels)


@dataclass
class Schedule:
    """The plan of one fit.

    Attributes:
        ladder: resolutions from coarse to fine.
        budget: seconds.
        patient: end when the validation views stop improving, before the budget does.
        most_rays: rays after which the fit ends, if the budget has not ended it before.
        slow_within: distance before a camera up to which things move slowly, working units (`losses`).
        trust: how far the images' depth is believed.
        rungs: share of the budget at which each level of the ladder ends at the latest.
        steps, steps_here: taken so far, in all and at this level.
        wider: times as many rays a step as `FIRST_BATCH` and `fit.max_rays`.
        prune_every: steps from one pruning to the next.
        hold: share of the budget before which the last level does not begin.
    """

    ladder: list[int]
    budget: float
    settings: FitSettings
    opaque: bool
    patient: bool = False
    most_rays: float = math.inf
    slow_within: float = 0.0
    trust: Trust = FINE
    rungs: tuple[float, ...] = RUNGS
    wider: int = 1
    prune_every: int = PRUNE_EVERY
    hold: float = 0.0
    level: int = 0
    steps: int = 0
    steps_here: int = 0
    slower: float = 1.0
    drops: int = 0
    ended: float | None = None  # share of the budget at which patience ended the search; what follows is polish
    looks: list[float] = default(default_factory=list)  # validation PSNR at this level and rate

    @property
    def resolution(self) -> int:
        return self.ladder[self.level]

    @property
    def finest(self) -> bool:
        return self.level == len(self.ladder) - 1

    def radius(self, done: float) -> float:
        """Deviation in pixels of the means that colours are at this level: 0 at the finest, and late in a fit that does not reach it."""
        sharp = self.finest or done > LAST_SOFT
        return 0.0 if sharp else min(MOST_SOFT, self.settings.soften * self.ladder[-1] / self.resolution)

    @property
    def rays(self) -> int:
        """Rays of the next step."""
        return self.wider * min(FIRST_BATCH * max(self.resolution, COARSEST) // COARSEST, self.settings.max_rays)

    def position(self, seconds: float, rays: int = 0) -> float:
        """0 … 1: how far the fit is, by its seconds or its rays, whichever are spent first.

        After patience has ended the search, a fifth of the time spent is left for polish.
        """
        done = max(seconds / self.budget, rays / self.most_rays, self.steps / (self.settings.iterations or math.inf))
        if self.ended is None:
            return done
        return LAST_PRUNE + (done - self.ended) / max(self.ended * (1 / LAST_PRUNE - 1), 1e-9) * (1 - LAST_PRUNE)

    def rays_left(self, seconds: float, rays: int) -> float:
        """Rays that the rest of the fit will have, at the pace so far."""
        return min((self.budget - seconds) * rays / max(seconds, 1e-3), self.most_rays - rays)

    def decided(self, done: float) -> bool:
        """Whether nothing is left to decide by the validation views, so that they can be fitted too."""
        return done >= LAST_PRUNE or (self.finest and not self.patient)

    def wants_look(self, done: float) -> bool:
        """Whether the validation views should be looked at now."""
        every = FINEST_LOOK_STEPS if self.finest else LOOK_STEPS
        return done < LAST_PRUNE and self.steps_here > 0 and self.steps_here % every == 0

    def look(self, psnr: float, done: float) -> None:
        """Note the validation views' PSNR; on a plateau of the finest level slow down, or stop searching."""
        self.looks.append(psnr)
        if self.finest and self.plateau():
            self.looks.clear()
            if self.drops < DROPS:
                self.drops += 1
                self.slower *= 0.5
            elif self.patient:
                self.ended = done

    def plateau(self) -> bool:
        """The last looks were hardly better than those before."""
        if len(self.looks) < 2 * WINDOW:
            return False
        before, after = self.looks[-2 * WINDOW : -WINDOW], self.looks[-WINDOW:]
        return sum(after) / WINDOW - sum(before) / WINDOW < (GAIN if self.finest else COARSE_GAIN)

    def wants_finer(self, done: float) -> bool:
        """Time for the next level: its share is spent, or the validation views gain nothing more here; or, in the paper's way, a number of
        steps was taken."""
        if every := self.settings.split_every:
            return not self.finest and self.steps_here >= every
        if self.finest or self.steps_here < LEVEL_STEPS or done >= self.rungs[-1]:
            return False
        if done < self.hold and self.level == len(self.ladder) - 2:
            return False
        return done > self.deadline() or self.plateau()

    def deadline(self) -> float:
        """Share of the budget at which this level ends at the latest. With a level of `FINER` voxels or more the finest begins when the
        last one below that would."""
        climbs, usual = len(self.ladder) - 1, sum(resolution < FINER for resolution in self.ladder[1:])
        place = self.level * max(usual - 1, 0) / (climbs - 1) if climbs > max(usual, 1) else self.level
        return float(np.interp(place, range(len(self.rungs)), self.rungs))

    def worth(self, voxels: float, rays_left: float, bounded: bool = True) -> bool:
        """Whether a finer level would see enough rays, and, if `bounded`, have few enough voxels; if not, this level is the last.

        Args:
            voxels: that it would have at most, were all of the voxels that stay split.
        """
        finer = self.ladder[self.level + 1]
        surface = voxels * self.resolution / finer  # a finer surface is thinner, too
        if rays_left >= WORTH * voxels if finer < FINER else surface <= min(FINE_MOST if bounded else math.inf, rays_left / FINE_WORTH):
            return True
        del self.ladder[self.level + 1 :]
        return False

    def climb(self) -> None:
        """The next level has begun."""
        self.level += 1
        self.steps_here = 0
        self.looks.clear()

    def wants_pruning(self, done: float) -> bool:
        every = self.settings.split_every or self.prune_every
        return self.steps_here > 0 and self.steps_here % every == 0 and done < LAST_PRUNE

    def rates(self, done: float, rays: int) -> Rates:
        """Step sizes: they fall with the rays that were fitted, whatever the machine took for them, on plateaus, and at the end."""
        fall = (1 + rays / SLOWING) ** -0.85 * self.slower * LAST_RATE ** max(0.0, (done - LAST_PRUNE) / (1 - LAST_PRUNE))
        fit = self.settings
        opacity = fit.opacity if self.opaque else 0.0
        depth = fit.depth * self.trust.weight * self.trust.share(done, rays)
        steps = (fit.rate_density * fall, fit.rate_feature * fall, fit.rate_decoder * fall)
        return Rates(*steps, fit.distortion, opacity, depth=depth, depth_noise=self.trust.noise, slow_within=self.slow_within)
