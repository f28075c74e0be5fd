# SPDX-License-Identifier: Apache-2.0
"""The body that a learned network knows: where the search begins when its samples are gone.

A checkpoint carries what was learned of an arm, but not the samples (`train --from-bag`, another
machine, a lost state). The corrected body is fitted to lengths that the network restores, so that
the first samples after that correct it instead of replacing it by the geometric model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.body_fit import Observations, Prior, fit_body
from musculoskeletal_ae.mae.mae import Mae

STATES = 400  # that the network is asked for
TRUST = 0.001  # [m] by which its lengths may err


def inherit(body: CorrectedBody, mae: Mae, prior: Prior, seed: int = 0) -> None:
    """Fit a body to what a network has learned, in place.

    Args:
        body: Becomes the network's.
        mae: Learned on a real arm.
        prior: How bodies differ from the geometric model.
        seed: Draws the states that are asked for.
    """
    robot, rng = body.robot, np.random.default_rng([seed, 0x1B])
    theta = robot.random_postures(STATES, rng)
    shape = STATES, robot.muscle_count
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, shape)
    seen = Observations(
        theta, tension, mae.lengths(theta, tension), np.zeros(shape), np.ones(shape, dtype=bool)
    )
    fit_body(body, seen, replace(prior, noise=TRUST))
