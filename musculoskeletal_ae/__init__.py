# SPDX-License-Identifier: Apache-2.0
"""Estimate, control and simulate musculoskeletal arms with a musculoskeletal autoencoder."""

import os

# Read when numpy is first imported. Matrices as small as a network's layers gain nothing from a
# second BLAS thread, and lose much where another process has the core.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
