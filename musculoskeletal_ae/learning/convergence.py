# SPDX-License-Identifier: Apache-2.0
"""Decides how many updates are made where all samples are known: as many as the network needs.

    e = exp(mean of log ‖θ_est − θ_w‖) over synthetic samples that were not trained

θ_w is the posture that the network should estimate (`body_model/synthetic.py`). The network learns
from the fitted body (`body_model/`), which hardly changes once all samples are known. Its error on
synthetic samples of this body falls to what their noise and the uncertainty of the body leave,
after 3 000 steps for a body that is nearly the geometric model, and after 20 000 for a soft robot
with 300 postures.
The updates end when e has stopped falling. No measured posture is held out for this decision, so
all of them can be learned.

On a running arm, each rest causes an update instead (`scheduler`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.synthetic import synthetic_samples
from musculoskeletal_ae.learning.scheduler import Update
from musculoskeletal_ae.mae.units import scale_vector

STEPS = 400  # train for this many steps in each update
#: end the updates if the error has fallen by less than LEAST_DECREASE during the last PATIENCE ones
PATIENCE, LEAST_DECREASE = 4, 0.01
#: make at least this many updates: the first ones still fit the body
LEAST_UPDATES = 8
MOST_UPDATES = 60  # end after this many updates, even if the error still falls
HELD_OUT = 1000  # compute the error on this many synthetic samples


def model_error(update: Update, body: CalibratedBody) -> float:
    """Return the error of an update's network on synthetic samples of the body [rad].

    It is the geometric mean of ‖θ_est − θ_w‖. Postures far from all samples, whose lengths are
    hardly known, therefore count no more than others. Equal bodies give equal samples.
    """
    data = synthetic_samples(body, update.noise, HELD_OUT, np.random.default_rng(0xE0))
    joints, muscles = body.robot.joint_count, body.robot.muscle_count
    entered, true = (part / scale_vector(joints, muscles) for part in data)
    _, tension, length = np.split(entered, [joints, joints + muscles], axis=1)
    estimate = update.mae.without(()).estimate(tension, length)
    error = np.linalg.norm(estimate.theta - true[:, :joints], axis=1)
    return float(np.exp(np.log(error).mean()))


def until_converged(
    make_update: Callable[[], Update | None], body: Callable[[], CalibratedBody | None]
) -> Iterator[tuple[Update, float]]:
    """Make updates until the network represents the body; yield each with its `model_error` [rad].

    The error is NaN if the preset fits no body.

    Args:
        make_update: Makes one update from all samples; None if there are too few.
        body: Returns the body of the last update; None if the preset fits no body.
    """
    errors = list[float]()
    while not is_reached(errors):
        update = make_update()
        if update is None:
            return
        fitted = body()
        errors.append(np.nan if fitted is None else model_error(update, fitted))
        yield update, errors[-1]
        if update.unchanged:
            return


def is_reached(errors: Sequence[float]) -> bool:
    """Return whether no more updates are needed, from the error after each update [rad].

    Without a learned body, LEAST_UPDATES are made.
    """
    count = len(errors)
    return count >= MOST_UPDATES or (count >= LEAST_UPDATES and not is_falling(errors))


def is_falling(errors: Sequence[float]) -> bool:
    """Return whether the error has fallen by LEAST_DECREASE during the last PATIENCE updates."""
    if len(errors) <= PATIENCE:
        return False
    before, recent = errors[-PATIENCE - 1], errors[-PATIENCE:]
    return min(recent) < (1.0 - LEAST_DECREASE) * before
