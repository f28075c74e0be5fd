# SPDX-License-Identifier: Apache-2.0
"""The inputs and the result of an update; the node exchanges them with its training process."""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.calibration import Healthy
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.mae.mae import Mae


class Job(NamedTuple):
    """A job for the training process: everything that an update of the network needs."""

    observed: Observations  # the samples, oldest first
    healthy: Healthy  # messages of the healthy arm, with which the anomaly detector is calibrated
    #: whether the statistics of the anomaly detector are valid for the present arm; not after a
    #: muscle has been changed
    statistics_hold: bool
    steps: int  # number of training steps of preset `default`
    isolated: tuple[int, ...] = ()  # indices of the muscles that the messages do not describe


class Update(NamedTuple):
    """The result of one update: the trained network, and what the update has found."""

    mae: Mae  # the trained network
    loss: float  # training loss
    #: σ of the part of each length that the body does not explain [m], (M,)
    noise: Array = np.empty(0)
    #: index of a muscle whose newest samples contradict the fitted body, and the number of these
    #: newest samples; at most one entry
    changed: tuple[tuple[int, int], ...] = ()
    #: mean 2-norms of θ_est − θ at the newest samples, over the revolute and over the prismatic
    #: joints (`JointUnits.mean_errors`), with θ_est of the network before the update [rad], (2,)
    errors: Array = np.full(2, np.nan)
    seconds: float = 0.0  # duration of the update [s]
    #: root mean square over the samples of what the constants of the body model cannot express, for
    #: each length [m], (M,); empty if the preset fits no body
    remainder: Array = np.empty(0)
    #: estimated joint-sensor offsets z [rad], (D,); empty if the preset estimates none
    sensor_offset: Array = np.empty(0)
    unchanged: str = ''  # why the network was not trained; '' if it was
