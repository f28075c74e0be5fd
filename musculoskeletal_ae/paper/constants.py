# SPDX-License-Identifier: Apache-2.0
"""The numbers that the paper prints, by section, and our choices where it prints none."""

from typing import Literal

# §III-A: units of the encoder's hidden layers; the decoder's are the reverse.
HIDDEN = (200, 30)
# Not printed. The descent through the decoder needs a smooth function, such as tanh.
ACTIVATION: Literal['tanh', 'silu'] = 'tanh'

# §III-B: L_initial and its descent.
WEIGHTS = (1.0, 10.0, 10.0)  # w_θ, w_T, w_l
INITIAL_EPOCHS = 30  # C_epoch
# "The number of batches C_batch = 100" can be read as 100 mini-batches in an epoch, or as
# mini-batches of 100 samples. With 10 000 samples, a number that is not printed, both hold.
INITIAL_BATCH = 100
INITIAL_SAMPLES = 10_000
INITIAL_STEPS = INITIAL_EPOCHS * INITIAL_SAMPLES // INITIAL_BATCH
STEP_SIZE = 1e-3  # of Adam; not printed, so this is Adam's default

# §III-C: online learning.
ONLINE_BATCHES = 10  # C_batch
ONLINE_EPOCHS = 10  # C_epoch
THRESHOLD = 20  # C_thre: learning begins when more samples than this are stored
DATA = 10  # C_data: stored samples drawn at random for each batch

# §III-E: the proposed control.
CONTROL_WEIGHTS = (1.0, 1.0, 0.01)  # w₁ of ‖T‖, w₂ of the posture, w₃ of the torque
CONTROL_LARGEST_STEP = 0.5  # γ_max
CONTROL_CANDIDATES = 10  # C_batch, called N_batch in the text
CONTROL_EPOCHS = 10  # C_epoch
# The unit of τ in w₃ and w₆ is not printed. We chose N·mm: for τ in N·m, w₃ is 10 and w₆ is 1. With
# N·m the torque hardly counts: the simulated arm ignores a force of 50 N, which the paper's arm
# follows, and `proposed` is far less accurate than `second` (doc/results/paper.md).
TORQUE_UNITS = 1e3  # [N·mm/(N·m)]
JOINT_STEP = 0.01  # Δθ [rad] of the muscle Jacobian; not printed

# §III-F: the simulations.
TENSION_WEIGHT, LENGTH_WEIGHT, TORQUE_WEIGHT, POSTURE_WEIGHT = 0.1, 1.0, 0.001, 1.0  # w₄ … w₇
SIMULATION_LARGEST_STEP = 0.2  # γ_max
SIMULATION_CANDIDATES = 10  # C_batch
SIMULATION_EPOCHS = 3  # C_epoch

# §IV-A: durations of the three steps of exploration [s].
DURATIONS = (5.0, 2.0, 3.0)
