# SPDX-License-Identifier: Apache-2.0
"""Estimate, control and simulate musculoskeletal arms with a musculoskeletal autoencoder."""

import os

from musculoskeletal_ae.pinocchio_wheel import prefer_wheel

# Read when numpy is first imported. Matrices as small as a network's layers gain nothing from a
# second BLAS thread, and lose much where another process has the core.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# Before any module of this package imports pinocchio.
prefer_wheel()
