# SPDX-License-Identifier: Apache-2.0
"""Estimate, control and simulate musculoskeletal arms with a musculoskeletal autoencoder."""

import os

from musculoskeletal_ae.pinocchio_wheel import prefer_wheel

# NumPy reads this variable on its first import. The matrix products of this package are too small
# to gain from a second BLAS thread, and become slower if another process occupies the second core.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# This must happen before any module of this package imports pinocchio.
prefer_wheel()
