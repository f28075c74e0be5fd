# SPDX-License-Identifier: Apache-2.0
"""The method of the paper, arranged by the paper's sections.

K. Kawaharazuka et al., "Musculoskeletal AutoEncoder: A Unified Online Acquisition Method of
Intersensory Networks for State Estimation, Control, and Simulation of Musculoskeletal Humanoids",
IEEE Robotics and Automation Letters, 2020. Section and equation numbers are the paper's:

    §III-A          network.py            layers, units, masks
    §III-B  (2, 3)  initial_training.py   random states of the geometric model, L_initial, Adam
    §III-C          online_learning.py    the batches, and when the network is updated
    §III-D  (4)     state_estimation.py   the anomaly detector that uses A
    §III-E  (5–8)   control.py            muscle stiffness control; geometric, first, second
    §III-E  (9–12)  control.py            the proposed control
    §III-E  (10,11) latent_descent.py     the descent in the latent space
    §III-F  (13,14) simulation.py         both simulations
    §IV-A           exploration.py        the three steps of random motion

`constants.py` holds the numbers of the paper, and the values that this project chose where the
paper gives none. doc/explanation/method.md lists the deliberate deviations.

Preset `paper` runs the code of this folder. Preset `default` uses two parts of it as well: the
methods `geometric`, `first` and `second`, and the three steps of random motion. Within the package,
only `presets/` imports from this folder. The network's arithmetic, Adam and the geometric model,
which both presets also use, are in other folders.
"""
