# SPDX-License-Identifier: Apache-2.0
"""The calibrated body: a geometric model whose parameters are fitted to samples.

`calibrated_body` is the model; begin there. `priors` states what is expected of its parameters,
`fit` and `postures` find them, and `body_fit` repeats the fit in each update. `remainder` learns
what the parameters cannot express, and `posture_regression` how joint angles follow from lengths.
"""
