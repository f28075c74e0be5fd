# SPDX-License-Identifier: Apache-2.0
"""The numbers of the paper by section, and our choices where it gives none."""

from typing import Literal

# §III-A: numbers of units in the hidden layers of the encoder; the decoder has the reverse order.
HIDDEN = (200, 30)
# Our choice: the descent through the decoder needs a smooth activation function, such as tanh.
ACTIVATION: Literal['tanh', 'silu'] = 'tanh'

# §III-B: L_initial and its descent.
WEIGHTS = (1.0, 10.0, 10.0)  # w_θ, w_T, w_l
INITIAL_EPOCHS = 30  # C_epoch
# "The number of batches C_batch = 100" can be read as 100 mini-batches in an epoch, or as
# mini-batches of 100 samples. We chose 10 000 samples, with which both hold.
INITIAL_BATCH = 100
INITIAL_SAMPLES = 10_000
INITIAL_STEPS = INITIAL_EPOCHS * INITIAL_SAMPLES // INITIAL_BATCH
STEP_SIZE = 1e-3  # step size of Adam; the paper gives none, so this is Adam's default

# §III-C: online learning.
ONLINE_BATCHES = 10  # C_batch
ONLINE_EPOCHS = 10  # C_epoch
THRESHOLD = 20  # C_thre: learning begins when more samples than this are stored
DATA = 10  # C_data: number of stored samples that are drawn at random for each batch

# §III-E: the proposed control.
CONTROL_WEIGHTS = (1.0, 1.0, 0.01)  # w₁ of ‖T‖, w₂ of the posture, w₃ of the torque
CONTROL_LARGEST_STEP = 0.5  # γ_max
CONTROL_CANDIDATES = 10  # C_batch, which the paper's text calls N_batch
CONTROL_EPOCHS = 10  # C_epoch
# The paper does not state the unit of τ to which w₃ and w₆ apply. We chose N·mm; converted to N·m,
# w₃ is 10 and w₆ is 1. If the paper's weights applied to N·m, the torque would hardly count: the
# simulated arm would ignore a force of 50 N, which the paper's arm follows, and `proposed` would be
# far less accurate than `second` (doc/results/paper.md).
TORQUE_UNITS = 1e3  # factor that converts τ from N·m to N·mm
JOINT_STEP = 0.01  # our choice: Δθ of the difference quotient for the muscle Jacobian [rad]

# §III-F: the simulations.
TENSION_WEIGHT = 0.1  # w₄
LENGTH_WEIGHT = 1.0  # w₅
TORQUE_WEIGHT = 0.001  # w₆
POSTURE_WEIGHT = 1.0  # w₇
SIMULATION_LARGEST_STEP = 0.2  # γ_max
SIMULATION_CANDIDATES = 10  # C_batch
SIMULATION_EPOCHS = 3  # C_epoch

# §IV-A: durations of the three steps of exploration [s].
DURATIONS = (5.0, 2.0, 3.0)
