"""Fits that follow records closely, for laws under which neighbouring motions part at once.

Where a body snaps from one well of a law into the next no run follows a record for long, and within a window of usual
length the misfit has more valleys than a search can pass. Windows of a few samples have not; each leads to the next but
for a little play, as states of a Kalman smoother do, and all begin from the motion that a force at the place implies,
which follows the record whatever the law.

Source: H. Bock, Multiple shooting, 1983; H. Abarbanel, Predicting the Future, 2013, chapter 2, for what is lost in
between.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

from jaxsid.gap.fit import links_of
from jaxsid.gap.locate import Scored, likeliest, scored
from jaxsid.gap.noise import Noise
from jaxsid.gap.recalibrate import Recalibrated
from jaxsid.gap.refit import (
    JUMP,
    Bench,
    Refit,
    bench_of,
    changes_of,
    in_windows,
    noise_part,
    refitted,
    states_at,
)
from jaxsid.gap.spectra import in_time
from jaxsid.gap.windows import SHORTEST
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

LENGTH = 4  # samples that a window judges
PLAY = 1.0  # of the noise next to the signal: of a state, from where a window ends to where the next begins
SLOWLY = 200  # steps of the search with hardly any play
OFTEN = 4  # beginnings in as many samples
PARTED = math.log(10.0)  # how far neighbours part, its logarithm, from which on usual windows may be too long


def closely(
    model: LumpedModel,
    records: Sequence[Record],
    noises: Sequence[Noise],
    refit: Recalibrated,
    found: Scored,
) -> Bench:
    """Records in windows of a few samples, the noise taken for white.

    Args:
        model: nominal; its effects are left out.
        records: with some of its sensors each.
        noises: of each.
        refit: the best linear model beside the records.
        found: places where what is left may arise, with the motion that a force at each implies.
    """
    bench = bench_of(model, records, list(map(_white, noises)), refit, length=LENGTH)
    play = PLAY * noise_part(bench)
    return begun_near(bench, found)._replace(jump=play, loose=play)


def followed_closely(bench: Bench) -> bool:
    """Whether a bench has windows of a few samples.

    Args:
        bench: records.
    """
    return math.isfinite(bench.loose)


def tightened(bench: Bench, found: Refit) -> tuple[Bench, Refit]:
    """A fit with hardly any play, as windows of usual length are tied, if its evidence is larger; else as it was.

    The search is slow then, and begins where that with play has ended.

    Args:
        bench: records.
        found: a fit to them.
    """
    if not followed_closely(bench):
        return bench, found
    tight = bench._replace(jump=JUMP * noise_part(bench))
    begin = {"changes": changes_of(found, bench), "states": found.fit.states}
    new = refitted(tight, found.hypothesis, **begin, steps=SLOWLY)
    return (tight, new) if new.fit.evidence > found.fit.evidence else (bench, found)


def implied(found: Scored) -> list[Float[np.ndarray, "samples n"]]:
    """The motion of every record that a force at the most probable place implies.

    Args:
        found: places, of the records.
    """
    row = found.places.index(likeliest(found))
    return [
        np.asarray(in_time(s.spectra, x.motion.states[row]))
        for s, x in zip(found.settings, found.found.explained, strict=True)
    ]


def begun_near(bench: Bench, found: Scored) -> Bench:
    """The bench with the motion to begin with that a force at the most probable place implies.

    Args:
        bench: records.
        found: places, of the records.
    """
    return bench._replace(states=states_at(bench.blocks, implied(found)))


def begun_along(bench: Bench, of: Bench, found: Refit) -> Bench:
    """The bench with the motion to begin with that a fit in windows of a few samples follows.

    Args:
        bench: records in windows of any length.
        of: the same records in those windows.
        found: the fit.
    """
    size, motions = 2 * len(of.model.bodies), []
    first = np.concatenate([np.asarray(b.first) for b in of.blocks])
    record = np.concatenate([np.asarray(b.record) for b in of.blocks])
    states = np.concatenate(found.fit.states)[:, :size]
    for number, moved in enumerate(of.moved):
        own = record == number
        q, v = np.split(states[own], 2, axis=1)
        path = CubicHermiteSpline(first[own] * moved.dt, q, v)
        times = np.arange(len(moved.u)) * moved.dt
        motions.append(np.concatenate([path(times), path(times, 1)], axis=1))
    return bench._replace(states=states_at(bench.blocks, motions))


def motions_to_begin(
    bench: Bench, records: Sequence[Record], noises: Sequence[Noise], found: Scored | None
) -> list[Float[np.ndarray, "samples n"]] | None:
    """Motions of records that windows of a few samples are searched from; None where a bench has usual ones.

    Args:
        bench: that tells which.
        records: whole ones.
        noises: of each.
        found: places, of the part of them that was seen.
    """
    if found is None or not followed_closely(bench):
        return None
    return implied(scored(bench.model, records, noises=noises, places=(likeliest(found),)))


def parting(bench: Bench, found: Refit) -> float:
    """Logarithm of how far neighbouring motions part at most, in no more samples than a short usual window has.

    Args:
        bench: records.
        found: a fit to them.
    """
    unit = bench.state_deviations(found.hypothesis.effects)
    ends = [np.asarray(x.ends) for x in in_windows(bench, found)]
    # slopes by the initial state come last
    slopes = np.concatenate([x[:, :, -x.shape[1] :] for x in ends]) * unit / unit[:, None]
    block = bench.blocks[0]
    stretch = max(SHORTEST // (block.y.shape[1] - block.lead), 1)
    led = dict(zip(*(x.tolist() for x in links_of(bench.blocks)), strict=True))
    most = 0.0
    for begin in range(0, len(slopes), max(stretch // OFTEN, 1)):
        at, whole = begin, slopes[begin]
        while np.isfinite(whole).all():
            most = max(most, math.log(max(float(np.linalg.norm(whole, 2)), 1.0)))
            if led.get(at) != at + 1 or at + 1 >= begin + stretch:
                break
            at += 1
            whole = slopes[at] @ whole
    return most


def _white(noise: Noise) -> Noise:
    return eqx.tree_at(lambda x: (x.level, x.taps), noise, (noise.rms(), noise.taps[:, :1]))
