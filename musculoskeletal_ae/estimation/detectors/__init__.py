# SPDX-License-Identifier: Apache-2.0
"""The detectors of the health monitor, one file for each kind of fault.

A ruptured tendon is found by `slack_tendon.py` (no tension although some is demanded), by
`residual_distance.py` (tensions and lengths do not fit each other) or, while no commands arrive, by
`length_disagreement.py`. Only `../suspect_verification.py` tells a rupture from a false sensor.
"""
