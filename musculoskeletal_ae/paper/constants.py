# SPDX-License-Identifier: Apache-2.0
"""The numbers of the paper by section, and our choices where it gives none."""

from typing import Literal

# §III-A: numbers of units in the hidden layers of the encoder; the decoder has the reverse order.
HIDDEN = (200, 30)
# Our choice: the descent through the decoder needs a smooth activation function, such as tanh.
ACTIVATION: Literal['tanh', 'silu'] = 'tanh'

# §III-B: L_initial and its descent.
WEIGHTS = (1.0, 10.0, 10.0)  # w_θ, w_T, w_l: weights of the errors of θ, T and l in the loss
INITIAL_EPOCHS = 30  # C_epoch: pass through all samples this many times
# "The number of batches C_batch = 100" can be read as 100 mini-batches in an epoch, or as
# mini-batches of 100 samples. We chose 10 000 samples, with which both hold.
INITIAL_BATCH = 100  # C_batch: samples in a mini-batch
INITIAL_SAMPLES = 10_000  # train on this many random states of the geometric model
INITIAL_STEPS = INITIAL_EPOCHS * INITIAL_SAMPLES // INITIAL_BATCH  # number of mini-batches in total
STEP_SIZE = 1e-3  # step size of Adam; the paper gives none, so this is Adam's default

# §III-C: online learning.
ONLINE_BATCHES = 10  # C_batch: draw this many batches for each update
ONLINE_EPOCHS = 10  # C_epoch: train this many times on each of these batches
THRESHOLD = 20  # C_thre: begin to learn when more samples than this are stored
DATA = 10  # C_data: draw this many stored samples at random for each batch

# §III-E: the proposed control.
CONTROL_WEIGHTS = (1.0, 1.0, 0.01)  # w₁, w₂, w₃: weights of tension, posture and torque
CONTROL_LARGEST_STEP = 0.5  # γ_max: try step sizes of the descent below this
#: C_batch, which the paper's text calls N_batch: try this many step sizes in each iteration
CONTROL_CANDIDATES = 10
CONTROL_EPOCHS = 10  # C_epoch: number of iterations
# The paper does not state the unit of τ to which w₃ and w₆ apply. We chose N·mm; converted to N·m,
# w₃ is 10 and w₆ is 1. If the paper's weights applied to N·m, the torque would hardly count: the
# simulated arm would ignore a force of 50 N, which the paper's arm follows, and `proposed` would be
# far less accurate than `second` (doc/results/paper.md).
TORQUE_UNITS = 1e3  # factor that converts τ from N·m to N·mm
JOINT_STEP = 0.01  # our choice: Δθ of the forward difference for the muscle Jacobian [rad]

# §III-F: the simulations.
TENSION_WEIGHT = 0.1  # w₄: weight of ‖T‖
LENGTH_WEIGHT = 1.0  # w₅: weight of the difference from the commanded lengths
TORQUE_WEIGHT = 0.001  # w₆: weight of the unbalanced torque
POSTURE_WEIGHT = 1.0  # w₇: weight of the difference from the angles to which joints are forced
SIMULATION_LARGEST_STEP = 0.2  # γ_max: try step sizes of the descent below this
SIMULATION_CANDIDATES = 10  # C_batch: try this many step sizes in each iteration
SIMULATION_EPOCHS = 3  # C_epoch: number of iterations

# §IV-A: durations of the three steps of exploration [s].
DURATIONS = (5.0, 2.0, 3.0)
