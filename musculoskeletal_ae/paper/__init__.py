# SPDX-License-Identifier: Apache-2.0
"""The paper's method to the letter, to be held beside the print.

K. Kawaharazuka et al., "Musculoskeletal AutoEncoder: A Unified Online Acquisition Method of
Intersensory Networks for State Estimation, Control, and Simulation of Musculoskeletal Humanoids",
IEEE Robotics and Automation Letters, 2020. Equations are numbered as in the print:

    §III-A          network.py            layers, units, masks
    §III-B  (2, 3)  initial_training.py   random states of the geometric model, L_initial, Adam
    §III-C          online_learning.py    the batches, and when the network is updated
    §III-D  (4)     state_estimation.py   the estimate, and the anomaly detector by A
    §III-E  (5–8)   control.py            muscle stiffness control; geometric, first, second
    §III-E  (9–12)  control.py            the proposed control
    §III-E  (10,11) latent_descent.py     the descent in the latent space
    §III-F  (13,14) simulation.py         both simulations
    §IV-A           exploration.py        the three steps of random motion

`constants.py` holds the printed numbers, and what this project chose where the print is silent.
Everything here runs as preset `paper`; `presets/` is the only other place that names it. What both
presets share (the network's arithmetic, Adam, the geometric model) is imported.
"""
